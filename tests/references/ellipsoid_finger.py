"""An ellipsoid that rolls without slip on a surface F(p) = 0, integrated to the eighth order.

Both contact points are integrated, p on the object and s on the ellipsoid (in its own frame):

    (W_o + R W_f R^T) p' = w x n        s' = R^T p'

with the shape operators of both from the second derivatives of their equations. These are Montana's equations without
coordinates. Nothing is shared with the kernels, which move the ellipsoid's centre by nearest points and use no
curvature. W_f is evaluated at the point with the normal opposite to the object's, since errors of s would grow; the
agreement of s, integrated by its own equation, verifies the path.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from references.rotation import Array, matrix
from softfinger.proxy.kernels import model
from softfinger.tools.accuracy.reference import compute_normal_and_curvature, integrate


class Rolled(NamedTuple):
    """End of a roll: centre, normal, orientation (4,), spin rad, distance m of s from the opposite normal."""

    center: Array
    normal: Array
    orientation: Array
    spin: float
    apart: float


def touching_at(semi_axes: ArrayLike, orientation: Array, normal: Array) -> Array:
    """Point (3,) of the ellipsoid, in its frame, with the outward normal opposite to `normal` (3,) of the world."""
    a = np.asarray(semi_axes, float)
    inward = -matrix(orientation).T @ normal
    return np.asarray(a**2 * inward / np.linalg.norm(a * inward))


def roll_ellipsoid(
    shape: Any,
    semi_axes: model.Vec3,
    orientation: ArrayLike,
    point: ArrayLike,
    rate: Callable[[float], ArrayLike],
    duration: float = 1.0,
) -> Rolled:
    """Roll from a contact at `point` (3,) m of the object at the angular velocity `rate` (3,) rad/s, of a time."""
    body = model.Ellipsoid(semi_axes, 1.0)

    def derivative(t: float, state: Array) -> Array:
        p, q, w = state[:3], state[6:10], np.asarray(rate(t), float)
        turned = matrix(q)
        n, bend = compute_normal_and_curvature(p, shape)
        _, own = compute_normal_and_curvature(touching_at(semi_axes, q, n), body)
        # Both operators act in the tangent plane; there is no equation along n.
        moved = np.linalg.solve(bend + turned @ own @ turned.T + np.outer(n, n), np.cross(w, n))
        turning = 0.5 * np.array([-w @ q[1:], *(q[0] * w + np.cross(w, q[1:]))])
        return np.concatenate([moved, turned.T @ moved, turning, [w @ n]])

    q = np.asarray(orientation, float)
    p = np.asarray(point, float)
    n, _ = compute_normal_and_curvature(p, shape)
    begin = np.concatenate([p, touching_at(semi_axes, q, n), q, [0.0]])
    end = integrate(derivative, 0.0, duration, begin, duration / 40).y[:, -1]
    p, s, q = end[:3], end[3:6], end[6:10]
    n, _ = compute_normal_and_curvature(p, shape)
    apart = float(np.linalg.norm(s - touching_at(semi_axes, q, n)))
    return Rolled(p - matrix(q) @ s, n, q, float(end[10]), apart)
