"""Rolling methods: algorithms that convert the rotation in a tick to a displacement of the contact."""

from typing import NamedTuple


class EulerZxz(NamedTuple):
    """Rolling by the ZXZ Euler angles of the rotation in a tick."""


class EulerZyx(NamedTuple):
    """Rolling by roll, pitch and yaw of the rotation in a tick."""


class RotationVector(NamedTuple):
    """Rolling in closed form, for a constant angular velocity within a tick."""


class Midpoint(NamedTuple):
    """Rolling by the midpoint rule."""


class MontanaRk4(NamedTuple):
    """Rolling integrated by one step of the classical fourth-order Runge-Kutta method."""


class MontanaRk45(NamedTuple):
    """Rolling integrated with step size control.

    tolerance  largest error of each partial step, relative to the fingertip's radius
    """

    tolerance: float
