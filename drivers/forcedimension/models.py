"""Limits of each of Force Dimension's devices, by the type number in its library.

Numbers: from the maker's header, and additional ones that CHAI3D's driver accepts. Limits: the recommended maxima in
that driver for omega, delta.3, sigma.7 and lambda.7. The other sigma and lambda models are assumed to have the limits
of their .7.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from softfinger.drivers.base import ModelLimits


class Model(NamedTuple):
    """Name in a rig, name with the hand it is made for, and limits."""

    name: str
    full_name: str
    limits: ModelLimits


OMEGA: Final = ModelLimits(12.0, 0.0, 5000.0, 30.0, 0.075)
DELTA: Final = ModelLimits(20.0, 0.0, 5000.0, 30.0, 0.15)
SIGMA_3: Final = ModelLimits(12.0, 0.0, 4000.0, 30.0, 0.075)
SIGMA_7: Final = SIGMA_3._replace(torque_max_nm=0.2)
LAMBDA_3: Final = ModelLimits(12.0, 0.0, 8000.0, 30.0, 0.1125)
LAMBDA_7: Final = LAMBDA_3._replace(torque_max_nm=0.2)
UNKNOWN: Final = ModelLimits(8.0, 0.0, 3000.0, 20.0, 0.04)
"""Limits for unlisted numbers: the lowest in CHAI3D for a device of this library (its Falcon), without torque."""

_SIGMA_6_RIGHT, _SIGMA_6_LEFT = (Model("sigma.6", f"sigma.6 {hand}", SIGMA_7) for hand in ("right", "left"))
_SIGMA_7_RIGHT, _SIGMA_7_LEFT = (Model("sigma.7", f"sigma.7 {hand}", SIGMA_7) for hand in ("right", "left"))
_LAMBDA_7_RIGHT, _LAMBDA_7_LEFT = (Model("lambda.7", f"lambda.7 {hand}", LAMBDA_7) for hand in ("right", "left"))

MODELS: Final = {
    33: Model("omega.3", "omega.3", OMEGA),
    34: Model("omega.6", "omega.6 right", OMEGA),
    36: Model("omega.6", "omega.6 left", OMEGA),
    35: Model("omega.7", "omega.7 right", OMEGA),
    37: Model("omega.7", "omega.7 left", OMEGA),
    63: Model("delta.3", "delta.3", DELTA),
    206: Model("sigma.3", "sigma.3", SIGMA_3),
    104: _SIGMA_7_RIGHT,
    105: _SIGMA_7_LEFT,
    203: Model("lambda.3", "lambda.3", LAMBDA_3),
    131: Model("lambda.6", "lambda.6 right", LAMBDA_3),
    132: Model("lambda.6", "lambda.6 left", LAMBDA_3),
    108: _LAMBDA_7_RIGHT,
    109: _LAMBDA_7_LEFT,
    # Only in CHAI3D's driver.
    110: Model("omega.3", "omega.3", OMEGA),
    111: Model("delta.3", "delta.3", DELTA),
    133: Model("sigma.3", "sigma.3", SIGMA_3),
    115: _SIGMA_6_RIGHT,
    116: _SIGMA_6_LEFT,
    **dict.fromkeys((102, 209), _SIGMA_7_RIGHT),
    103: _SIGMA_7_LEFT,
    **dict.fromkeys((112, 114, 117, 119, 121, 123, 125, 127, 129, 210), _LAMBDA_7_RIGHT),
    **dict.fromkeys((113, 118, 120, 122, 124, 126, 128, 130, 211), _LAMBDA_7_LEFT),
}
"""Models by `dhdGetSystemType`."""


def find_model(kind: int) -> Model:
    """Return the model for a number of `dhdGetSystemType`; an unnamed one with the lowest limits if it is unknown."""
    return MODELS.get(kind) or Model("", f"device of unknown type {kind}", UNKNOWN)
