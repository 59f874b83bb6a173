"""What each of Force Dimension's devices can do, by the number its library gives it.

Limits: the recommended maxima of CHAI3D's driver for omega, delta.3, sigma.7 and lambda.7. The other sigma and lambda
are assumed to have those of their .7; for the damping of a lambda nothing is published, so it has what the others have.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Limits(NamedTuple):
    """N, N m (0: no motors turn the handle), N/m, N s/m, and the radius of the workspace, m."""

    force_max_n: float
    torque_max_nm: float
    stiffness_max_n_per_m: float
    damping_max_ns_per_m: float
    workspace_radius_m: float


class Model(NamedTuple):
    """Name in a rig, name with the hand it is for, and limits."""

    name: str
    full_name: str
    limits: Limits


OMEGA: Final = Limits(12.0, 0.0, 5000.0, 30.0, 0.075)
DELTA: Final = Limits(20.0, 0.0, 5000.0, 30.0, 0.15)
SIGMA_3: Final = Limits(12.0, 0.0, 4000.0, 30.0, 0.075)
SIGMA_7: Final = SIGMA_3._replace(torque_max_nm=0.2)
LAMBDA_3: Final = Limits(12.0, 0.0, 8000.0, 30.0, 0.1125)
LAMBDA_7: Final = LAMBDA_3._replace(torque_max_nm=0.2)

MODELS: Final = {
    33: Model("omega.3", "omega.3", OMEGA),
    34: Model("omega.6", "omega.6 right", OMEGA),
    36: Model("omega.6", "omega.6 left", OMEGA),
    35: Model("omega.7", "omega.7 right", OMEGA),
    37: Model("omega.7", "omega.7 left", OMEGA),
    63: Model("delta.3", "delta.3", DELTA),
    206: Model("sigma.3", "sigma.3", SIGMA_3),
    104: Model("sigma.7", "sigma.7 right", SIGMA_7),
    105: Model("sigma.7", "sigma.7 left", SIGMA_7),
    203: Model("lambda.3", "lambda.3", LAMBDA_3),
    131: Model("lambda.6", "lambda.6 right", LAMBDA_3),
    132: Model("lambda.6", "lambda.6 left", LAMBDA_3),
    108: Model("lambda.7", "lambda.7 right", LAMBDA_7),
    109: Model("lambda.7", "lambda.7 left", LAMBDA_7),
}
"""By `dhdGetSystemType`."""
