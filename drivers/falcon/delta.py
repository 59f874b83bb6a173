"""Dimensions of the Falcon's mechanism, a delta; `kinematics.delta` has the equations.

In the device's frame x points to the right, y up and z towards the user.

Source: the dimensions of libnifalcon.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import Final

from softfinger.drivers.kinematics.delta import Delta

RAD_PER_COUNT: Final = 0.01425 / 0.110 * 2.0 * pi / 1280.0
"""Leg angle per encoder count: ratio of drum to leg radius, counts per turn of the motor."""
THETA_ZERO: Final = 35.0 * pi / 180.0
"""Leg angle (rad) at encoder count 0."""

_LEGS: Final = (105.0 * pi / 180.0, -15.0 * pi / 180.0, -135.0 * pi / 180.0)
HOME: Final = (0.0, 0.0, 0.11)
"""m: initial value of a search without a last solution; within every leg's reach."""
FALCON: Final = Delta(
    arm=0.060,
    rod=0.1025,
    end=0.01443,
    joints=0.0225,
    shift=-0.025,
    base=0.0400,
    offset=-0.02309,
    cos=(cos(_LEGS[0]), cos(_LEGS[1]), cos(_LEGS[2])),
    sin=(sin(_LEGS[0]), sin(_LEGS[1]), sin(_LEGS[2])),
    home=HOME,
    origin=(0.0, 0.0, 0.0),
)
