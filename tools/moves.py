"""Moves of which the motions of the shipped recordings consist."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

RATE_HZ: Final = 100
RADIUS_M: Final = 0.010
ABOVE_M: Final = 0.020
PRESSED_M: Final = 0.009
"""Radius of the fingertip, and heights of its centre in free space and on the plane."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Move(NamedTuple):
    """Minimum-jerk move: duration (s), travel (m, world), turn (rotation vector, rad, world axes)."""

    seconds: float
    travel: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)


def hold(seconds: float) -> Move:
    return Move(seconds)


def press(seconds: float) -> Move:
    return Move(seconds, (0.0, 0.0, PRESSED_M - ABOVE_M))


def release(seconds: float) -> Move:
    return Move(seconds, (0.0, 0.0, ABOVE_M - PRESSED_M))


def roll(seconds: float, about_x: float = 0.0, about_y: float = 0.0, followed: float = 1.0) -> Move:
    """Roll by radians about a world axis; the hand follows the fraction `followed` of the path of the contact."""
    # without slip the centre travels r (turn x n), n = +z
    return Move(seconds, (followed * RADIUS_M * about_y, -followed * RADIUS_M * about_x, 0.0), (about_x, about_y, 0.0))


def spin(seconds: float, angle: float) -> Move:
    return Move(seconds, turn=(0.0, 0.0, angle))


def drag(distance: float, speed: float) -> Move:
    """Slide along x, at most at `speed` (m/s)."""
    seconds = 1.875 * abs(distance) / speed  # peak over mean velocity of a minimum-jerk move
    return Move(math.ceil(seconds * RATE_HZ) / RATE_HZ, (distance, 0.0, 0.0))


def opposite(travel: Vector) -> Vector:
    x, y, z = travel
    return (-x, -y, -z)
