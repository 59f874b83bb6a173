"""What a scene is made of, as named tuples of float64: the parts, the state of a contact, the outcome of a step.

A part that a scene does not have is None, and the kernel for None does nothing: it is not compiled.
Lengths m, forces N, angles rad; vectors (3,) in the world frame unless said; quaternions w, x, y, z.
"""

from softfinger.proxy.kernels.model.contact import Contact, Hold, State, Tick
from softfinger.proxy.kernels.model.effects import (
    Anchor,
    BoxBoundary,
    BoxRegion,
    ConstantForce,
    Magnet,
    NormalVibration,
    Phase,
    SphereBoundary,
    SphereRegion,
    Spring,
    StickSlip,
    Touching,
    Vibration,
    Viscosity,
)
from softfinger.proxy.kernels.model.laws import (
    Anisotropic,
    Friction,
    LimitSurface,
    PaperFriction,
    PowerTorsion,
    SoftFingerProxy,
    SpeedFriction,
    Stribeck,
    Torsion,
)
from softfinger.proxy.kernels.model.methods import EulerZxz, EulerZyx, Midpoint, MontanaRk4, MontanaRk45, RotationVector
from softfinger.proxy.kernels.model.motions import Driven, Place, Pose, Sinusoid, Turntable
from softfinger.proxy.kernels.model.scene import Coupling, Material, Object, Scene
from softfinger.proxy.kernels.model.shapes import (
    Box,
    CappedCylinder,
    Capsule,
    Cylinder,
    Ellipsoid,
    Plane,
    Sphere,
    Torus,
)
from softfinger.proxy.kernels.model.vectors import ZERO, Quaternion, Vec3

__all__ = [
    "ZERO",
    "Anchor",
    "Anisotropic",
    "Box",
    "BoxBoundary",
    "BoxRegion",
    "CappedCylinder",
    "Capsule",
    "ConstantForce",
    "Contact",
    "Coupling",
    "Cylinder",
    "Driven",
    "Ellipsoid",
    "EulerZxz",
    "EulerZyx",
    "Friction",
    "Hold",
    "LimitSurface",
    "Magnet",
    "Material",
    "Midpoint",
    "MontanaRk4",
    "MontanaRk45",
    "NormalVibration",
    "Object",
    "PaperFriction",
    "Phase",
    "Place",
    "Plane",
    "Pose",
    "PowerTorsion",
    "Quaternion",
    "RotationVector",
    "Scene",
    "Sinusoid",
    "SoftFingerProxy",
    "SpeedFriction",
    "Sphere",
    "SphereBoundary",
    "SphereRegion",
    "Spring",
    "State",
    "StickSlip",
    "Stribeck",
    "Tick",
    "Torsion",
    "Torus",
    "Touching",
    "Turntable",
    "Vec3",
    "Vibration",
    "Viscosity",
]
