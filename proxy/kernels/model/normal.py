"""Laws of the normal force as a function of depth and speed: their coefficients."""

from typing import Any, NamedTuple


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
