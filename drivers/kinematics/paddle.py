"""A paddle: one joint, and a handle of length r on it that moves on an arc.

The joint turns by a about the y axis from the middle of its range, where the handle stands along z. With the origin at
the end of the handle in the middle of its range

    P = (r sin a, 0, r (cos a - 1)),   dP/da = (r cos a, 0, -r sin a),   tau = dP/da . f
"""

from __future__ import annotations

from math import cos, sin

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3


@jit
def forward(length: float, a: float) -> Vec3:
    """Position (3,) m of the end of a handle of `length` (m) in the device's frame, at a joint angle (rad)."""
    return (length * sin(a), 0.0, length * (cos(a) - 1.0))


@jit
def jacobian(length: float, a: float) -> Vec3:
    """dP/da, (3,) m/rad: along the arc."""
    return (length * cos(a), 0.0, -length * sin(a))


@jit
def torques_for(length: float, a: float, force: Vec3) -> Vec3:
    """Joint torque (3,) N m, the last two 0, for a force (3,) N in the device's frame; across the arc none of it."""
    return (vec3.dot(jacobian(length, a), force), 0.0, 0.0)
