"""Parameters of the fingertip's contact patch, and of the laws that depend on its size."""

from typing import Any, NamedTuple


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
