"""Rolling methods: how a tick's rotation is turned into a roll of the contact."""

from typing import NamedTuple


class EulerZxz(NamedTuple):
    """Rolling by the ZXZ Euler angles of each tick's rotation; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class EulerZyx(NamedTuple):
    """Rolling by the roll, pitch and yaw of each tick's rotation; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class RotationVector(NamedTuple):
    """Rolling in closed form, for a constant rate within a tick; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class Midpoint(NamedTuple):
    """Rolling by the midpoint rule; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class MontanaRk4(NamedTuple):
    """Rolling integrated by one step of the classical Runge-Kutta rule; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class MontanaRk45(NamedTuple):
    """Rolling integrated with step control.

    torque_stiffness  N/m  k_tau
    tolerance         1    error allowed for each part of the step, relative to the fingertip's radius
    """

    torque_stiffness: float
    tolerance: float
