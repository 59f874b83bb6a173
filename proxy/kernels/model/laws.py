"""Friction and torsion laws: their coefficients. What a material does not have is None."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Vec3


class Friction(NamedTuple):
    """Coulomb friction; 0 <= kinetic <= static."""

    static: float
    kinetic: float


class Stribeck(NamedTuple):
    """Slip speed, m/s, over which friction falls from its static to its kinetic value; 0: at once."""

    speed: float


class SpeedFriction(NamedTuple):
    """Friction that changes with the slip speed: Stribeck or None, and a viscous coefficient, s/m."""

    static: float
    kinetic: float
    stribeck: Any
    viscous: float


class Anisotropic(NamedTuple):
    """A friction law whose coefficients are scaled along a direction of the surface and across it.

    law        Friction or SpeedFriction
    direction  (3,)  in the frame of the object's pose, where that turns it, else in the world; its part tangent
                     to the surface counts
    """

    law: Any
    direction: Vec3
    static_along: float
    static_across: float
    kinetic_along: float
    kinetic_across: float


class PaperFriction(NamedTuple):
    """Coulomb friction under the paper's switching rule read to the letter, for study."""

    static: float
    kinetic: float


class Torsion(NamedTuple):
    """Torsional spring about the normal, N m/rad, and the length whose product with f_N is its limit, m."""

    stiffness: float
    friction_length: float


class PowerTorsion(NamedTuple):
    """As Torsion, with the limit friction_length f_N (f_N / 1 N)^exponent; exponent 0 to 1/3."""

    stiffness: float
    friction_length: float
    exponent: float


class LimitSurface(NamedTuple):
    """Tangential force and moment share one limit; `law` (Torsion or PowerTorsion) is its torsional axis."""

    law: Any


class SoftFingerProxy(NamedTuple):
    """A proxy that also turns, with a torsional cone of its own: it sticks below the limit of `law` (Torsion
    or PowerTorsion), and slips at `kinetic_share` (0 to 1) of it."""

    law: Any
    kinetic_share: float
