"""Rolling methods: how a tick's rotation is turned into a roll of the contact."""

from typing import NamedTuple


class EulerZxz(NamedTuple):
    """Rolling by the ZXZ Euler angles of each tick's rotation."""


class EulerZyx(NamedTuple):
    """Rolling by the roll, pitch and yaw of each tick's rotation."""


class RotationVector(NamedTuple):
    """Rolling in closed form, for a constant rate within a tick."""


class Midpoint(NamedTuple):
    """Rolling by the midpoint rule."""


class MontanaRk4(NamedTuple):
    """Rolling integrated by one step of the classical Runge-Kutta rule."""


class MontanaRk45(NamedTuple):
    """Rolling integrated with step control.

    tolerance  error allowed for each part of the step, relative to the fingertip's radius
    """

    tolerance: float
