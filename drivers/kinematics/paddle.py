"""Paddle: one joint with a handle of length r, which moves on an arc.

The joint angle a about the y axis is 0 in the middle of the range, with the handle along z. With the origin at the end
of the handle in the middle of the range

    P = (r sin a, 0, r (cos a - 1)),   dP/da = (r cos a, 0, -r sin a),   tau = dP/da . f
"""

from __future__ import annotations

from math import cos, sin

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3


@jit
def forward(length: float, a: float) -> Vec3:
    """Return the position (3,) m of the end of a handle of `length` (m), device's frame, at joint angle `a` (rad)."""
    return (length * sin(a), 0.0, length * (cos(a) - 1.0))


@jit
def compute_jacobian(length: float, a: float) -> Vec3:
    """Return dP/da, (3,) m/rad, which is tangent to the arc."""
    return (length * cos(a), 0.0, -length * sin(a))


@jit
def compute_torques(length: float, a: float, force: Vec3) -> Vec3:
    """Return the joint torque (3,) N m, the last two 0, for a force (3,) N, device's frame.

    Only the part of the force along the arc is displayed.
    """
    return (vec3.dot(compute_jacobian(length, a), force), 0.0, 0.0)
