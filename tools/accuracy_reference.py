"""Rolling without slip on surfaces given by an equation F(p) = 0, integrated to the eighth order.

The contact point moves by p' = (W_o + I / r)^-1 (w x n), with the normal n from the gradient of F and the
shape operator W_o from its second derivatives: nothing is shared with the kernels, which move the
fingertip's centre by closest points and know no curvature. Shapes with edges have no such equation; for
them the centre is moved, with the nearest point of the solid found by clamping.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model

Array = NDArray[np.float64]
Gradient = tuple[Array, Array]
"""First (3,) and second (3, 3) derivatives of F."""


def plane(p: Array, shape: model.Plane) -> Gradient:
    return np.array(shape.normal), np.zeros((3, 3))


def sphere(p: Array, shape: model.Sphere) -> Gradient:
    return 2 * p, 2 * np.eye(3)


def cylinder(p: Array, shape: model.Cylinder) -> Gradient:
    flat = np.diag([2.0, 2.0, 0.0])
    return flat @ p, flat


def ellipsoid(p: Array, shape: model.Ellipsoid) -> Gradient:
    hessian = np.diag(2 / np.array(shape.semi_axes) ** 2)
    return hessian @ p, hessian


def torus(p: Array, shape: model.Torus) -> Gradient:
    """F = (q - a)^2 + z^2 - b^2 with q the distance from the axis."""
    flat = np.array([p[0], p[1], 0.0])
    q = np.hypot(p[0], p[1])
    hessian = np.diag([2 - 2 * shape.major / q] * 2 + [2.0]) + 2 * shape.major / q**3 * np.outer(flat, flat)
    return np.array([2 * (1 - shape.major / q) * p[0], 2 * (1 - shape.major / q) * p[1], 2 * p[2]]), hessian


GRADIENTS: dict[type, Callable[..., Gradient]] = {
    model.Plane: plane,
    model.Sphere: sphere,
    model.Cylinder: cylinder,
    model.Ellipsoid: ellipsoid,
    model.Torus: torus,
}


def normal_and_curvature(p: Array, shape: Any) -> tuple[Array, Array]:
    """Unit normal (3,) to where the fingertip is, and shape operator (3, 3) dn/dp on the tangent plane."""
    gradient, hessian = GRADIENTS[type(shape)](p, shape)
    size, side = np.linalg.norm(gradient), getattr(shape, "side", 1.0)
    n = gradient / size
    project = np.eye(3) - np.outer(n, n)
    return side * n, side * project @ hessian @ project / size


def nearest(x: Array, shape: Any) -> Array:
    """The point of a convex solid (or of a hollow capsule's skeleton) that decides the normal at x."""
    if isinstance(shape, model.Box):
        h = np.array(shape.half_extents)
        return np.clip(x, -h, h)
    z = np.clip(x[2], -shape.half_length, shape.half_length)
    if isinstance(shape, model.Capsule):
        return np.array([0.0, 0.0, z])
    q = np.hypot(x[0], x[1])
    return np.array([x[0], x[1], 0.0]) * min(1.0, shape.radius / q if q else 1.0) + np.array([0.0, 0.0, z])


def center_normal(x: Array, shape: Any) -> Array:
    """Unit normal (3,) of the offset surface through the centre x."""
    away = x - nearest(x, shape)
    return getattr(shape, "side", 1.0) * away / np.linalg.norm(away)


class Path:
    """A rolled path, to be asked for any times of it."""

    def __init__(self, shape: Any, radius: float, solution: Callable[[Array], Array]) -> None:
        self._shape, self._radius, self._solution = shape, radius, solution

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Contact points (n, 3) m, unit normals (n, 3) and spins (n,) rad at `times` (n,) s."""
        state = np.asarray(self._solution(times)).T
        if type(self._shape) in GRADIENTS:
            normals = np.array([normal_and_curvature(p, self._shape)[0] for p in state[:, :3]])
            return state[:, :3], normals, state[:, 3]
        normals = np.array([center_normal(x, self._shape) for x in state[:, :3]])
        return state[:, :3] - self._radius * normals, normals, state[:, 3]


def roll_path(
    shape: Any,
    radius: float,
    center: ArrayLike,
    normal: ArrayLike,
    rate: Callable[[float], ArrayLike],
    duration: float = 1.0,
    steps: int = 10,
) -> Path:
    """The path of a fingertip that rolls without slip.

    radius         m      of the fingertip
    center  (3,)   m      of the fingertip at time 0
    normal  (3,)          unit normal under it
    rate           rad/s  angular velocity (3,) of the fingertip against the object at a time, in the object's frame
    duration       s
    steps                 least number of steps. Between steps the path is interpolated to the seventh order, without
                          error control: a fortieth of a radian a step leaves 1e-15 of the radius
    """
    try:
        from scipy.integrate import solve_ivp
    except ImportError as error:
        raise ConfigError("the reference path needs scipy: pip install 'softfinger[accuracy]'") from error
    smooth = type(shape) in GRADIENTS
    start = np.asarray(center, float) - (radius * np.asarray(normal, float) if smooth else 0.0)

    def derivative(t: float, state: Array) -> Array:
        w = np.asarray(rate(t), float)
        if smooth:
            n, bend = normal_and_curvature(state[:3], shape)
            return np.append(np.linalg.solve(bend + np.eye(3) / radius, np.cross(w, n)), w @ n)
        n = center_normal(state[:3], shape)
        return np.append(radius * np.cross(w, n), w @ n)

    # On shapes with edges the curvature jumps: short steps leave little of it to the error control.
    longest = duration / max(steps, 10 if smooth else 100)
    span, first = (0.0, duration), np.append(start, 0.0)
    found = solve_ivp(
        derivative, span, first, method="DOP853", rtol=1e-13, atol=1e-17, max_step=longest, dense_output=True
    )
    return Path(shape, radius, found.sol)


def rolled(
    shape: Any,
    radius: float,
    center: ArrayLike,
    normal: ArrayLike,
    rate: Callable[[float], ArrayLike],
    duration: float = 1.0,
) -> tuple[Array, Array, float]:
    """Centre (3,) m, normal (3,) and spin (rad) at the end of the path; arguments as for `roll_path`."""
    points, normals, spins = roll_path(shape, radius, center, normal, rate, duration).at(np.array([duration]))
    return points[0] + radius * normals[0], normals[0], float(spins[0])
