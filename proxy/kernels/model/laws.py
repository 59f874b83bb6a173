"""Laws of the normal force, of friction, torsion and the contact patch: their coefficients. A missing law is None."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Vec3


class LinearNormal(NamedTuple):
    """Spring, N/m, and bounded damper, N s/m (Kelvin-Voigt)."""

    stiffness: float
    damping: float


class PowerNormal(NamedTuple):
    """Spring coefficient * depth^exponent, N/m^exponent, and bounded damper, N s/m; exponent 3/2 is Hertz's."""

    coefficient: float
    exponent: float
    damping: float


class HuntCrossley(NamedTuple):
    """Normal force of `law` (LinearNormal or PowerNormal), and damping proportional to it: c, s/m."""

    law: Any
    damping: float


class Friction(NamedTuple):
    """Coulomb friction; 0 <= kinetic <= static."""

    static: float
    kinetic: float


class Stribeck(NamedTuple):
    """Slip speed, m/s, over which friction decreases from its static to its kinetic value; 0: instantly."""

    speed: float


class SpeedFriction(NamedTuple):
    """Friction that depends on the slip speed: Stribeck or None, and a viscous coefficient, s/m."""

    static: float
    kinetic: float
    stribeck: Any
    viscous: float


class AnisotropicFriction(NamedTuple):
    """Friction law with coefficients scaled along a direction of the surface and across it.

    law        Friction or SpeedFriction
    direction  (3,)  in the frame of the object's pose if that has a rotation, otherwise in the world; only its part
                     tangential to the surface counts
    """

    law: Any
    direction: Vec3
    static_along: float
    static_across: float
    kinetic_along: float
    kinetic_across: float


class PaperFriction(NamedTuple):
    """Coulomb friction with the paper's switching rule taken literally, for study."""

    static: float
    kinetic: float


class Torsion(NamedTuple):
    """Torsional spring about the normal, N m/rad; its limit is friction_length (m) times the normal force f_N."""

    stiffness: float
    friction_length: float


class PowerTorsion(NamedTuple):
    """Torsion with the limit friction_length f_N (f_N / 1 N)^exponent; exponent 0 to 1/3."""

    stiffness: float
    friction_length: float
    exponent: float


class LimitSurface(NamedTuple):
    """Tangential force and moment that share one limit; `law` (Torsion or PowerTorsion) is its torsional axis."""

    law: Any


class SoftFingerProxy(NamedTuple):
    """Proxy that also rotates, with a separate torsional friction cone.

    It sticks below the limit of `law` (Torsion or PowerTorsion), and slips at `kinetic_share` (0 to 1) of it.
    """

    law: Any
    kinetic_share: float


class HertzPatch(NamedTuple):
    """Patch of an elastic sphere on a plane.

    compliance  m^2/N  1/G, G the fingertip's shear modulus
    rolling            RollingLoss or None
    """

    compliance: float
    rolling: Any


class PowerPatch(NamedTuple):
    """Patch with the radius `at_newton` (f_N / 1 N)^exponent.

    at_newton   m      radius at 1 N
    exponent           0 to 1/3
    lever              mean distance of the pressure from the centre, over the patch's radius
    compliance  m^2/N  1/G, G the fingertip's shear modulus
    rolling            RollingLoss or None
    """

    at_newton: float
    exponent: float
    lever: float
    compliance: float
    rolling: Any


class RollingLoss(NamedTuple):
    """Fraction of the elastic work that rolling dissipates, 0 to 1."""

    share: float


class PatchTorsion(NamedTuple):
    """Torsion computed from the fingertip's patch; `friction` is mu_s of the object."""

    friction: float
