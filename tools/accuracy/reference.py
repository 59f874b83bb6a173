"""Reference for rolling without slip on surfaces with an equation F(p) = 0, integrated to the eighth order.

The contact point moves by p' = (W_o + I / r)^-1 (w x n). The normal n follows from the gradient of F, and the shape
operator W_o from its second derivatives. Nothing is shared with the kernels, which move the fingertip's centre by
closest points and do not use curvature. Shapes with edges have no such equation. For them the centre is moved, the
nearest point of the solid is found by clamping, and the integration restarts at every edge that is crossed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model
from softfinger.tools.measure import Array

Gradient = tuple[Array, Array]
"""First (3,) and second (3, 3) derivatives of F at p, for a surface F(p) = 0."""


def compute_plane_gradient(p: Array, shape: model.Plane) -> Gradient:
    return np.array(shape.normal), np.zeros((3, 3))


def compute_sphere_gradient(p: Array, shape: model.Sphere) -> Gradient:
    return 2 * p, 2 * np.eye(3)


def compute_cylinder_gradient(p: Array, shape: model.Cylinder) -> Gradient:
    flat = np.diag([2.0, 2.0, 0.0])
    return flat @ p, flat


def compute_ellipsoid_gradient(p: Array, shape: model.Ellipsoid) -> Gradient:
    hessian = np.diag(2 / np.array(shape.semi_axes) ** 2)
    return hessian @ p, hessian


def compute_torus_gradient(p: Array, shape: model.Torus) -> Gradient:
    """Use F = (q - a)^2 + z^2 - b^2 with q the distance from the axis."""
    flat = np.array([p[0], p[1], 0.0])
    q = np.hypot(p[0], p[1])
    hessian = np.diag([2 - 2 * shape.major / q] * 2 + [2.0]) + 2 * shape.major / q**3 * np.outer(flat, flat)
    return np.array([2 * (1 - shape.major / q) * p[0], 2 * (1 - shape.major / q) * p[1], 2 * p[2]]), hessian


class Hills(NamedTuple):
    """Surface z = amplitude cos(k x) cos(k y), k = 2 pi / wavelength, m; it is not a shape of the kernels."""

    amplitude: float
    wavelength: float

    def height(self, x: Any, y: Any) -> Any:
        k = 2.0 * np.pi / self.wavelength
        return self.amplitude * np.cos(k * x) * np.cos(k * y)


def compute_hills_gradient(p: Array, shape: Hills) -> Gradient:
    """Use F = z - h(x, y)."""
    a, k = shape.amplitude, 2.0 * np.pi / shape.wavelength
    (cx, cy), (sx, sy) = np.cos(k * p[:2]), np.sin(k * p[:2])
    hessian = a * k * k * np.array([[cx * cy, -sx * sy, 0.0], [-sx * sy, cx * cy, 0.0], [0.0, 0.0, 0.0]])
    return np.array([a * k * sx * cy, a * k * cx * sy, 1.0]), hessian


GRADIENTS: dict[type, Callable[..., Gradient]] = {
    model.Plane: compute_plane_gradient,
    model.Sphere: compute_sphere_gradient,
    model.Cylinder: compute_cylinder_gradient,
    model.Ellipsoid: compute_ellipsoid_gradient,
    model.Torus: compute_torus_gradient,
    Hills: compute_hills_gradient,
}


def compute_normal_and_curvature(p: Array, shape: Any) -> tuple[Array, Array]:
    """Return the unit normal (3,) towards the fingertip, and the shape operator (3, 3) dn/dp on the tangent plane."""
    gradient, hessian = GRADIENTS[type(shape)](p, shape)
    size, side = np.linalg.norm(gradient), getattr(shape, "side", 1.0)
    n = gradient / size
    project = np.eye(3) - np.outer(n, n)
    return side * n, side * project @ hessian @ project / size


def find_levels(x: Array, shape: Any) -> tuple[Array, Array]:
    """Return the coordinates of x along which a shape with edges ends, and the ends, m: it spans -end to +end."""
    if isinstance(shape, model.Box):
        return x, np.array(shape.half_extents)
    if isinstance(shape, model.Capsule):
        return x[2:], np.array([shape.half_length])
    return np.array([np.hypot(x[0], x[1]), x[2]]), np.array([shape.radius, shape.half_length])


def find_feature(x: Array, shape: Any) -> Array:
    """Return the feature below x: for each of `find_levels`, 0 between the ends, else the sign of the end passed."""
    level, end = find_levels(x, shape)
    return np.asarray(np.where(np.abs(level) > end, np.sign(level), 0.0))


def compute_center_normal(x: Array, shape: Any, past: Array) -> Array:
    """Return the unit normal (3,) of the offset surface through the centre x, over the feature `past` without its ends.

    It points away from the nearest point of the solid, or of the axis of the hollow capsule.
    """
    level, end = find_levels(x, shape)
    level_after = np.where(past == 0.0, level, past * end)
    if isinstance(shape, model.Box):
        nearest = level_after
    elif isinstance(shape, model.Capsule):
        nearest = np.array([0.0, 0.0, level_after[0]])
    else:
        nearest = np.array([x[0] * level_after[0] / level[0], x[1] * level_after[0] / level[0], level_after[1]])
    away = x - nearest
    return np.asarray(getattr(shape, "side", 1.0) * away / np.linalg.norm(away))


class Path:
    """Rolled path that can be evaluated at any times.

    pieces   end of a piece, s, and its state (4, n) at given times (n,): contact point, or centre on shapes with
             edges, and spin
    """

    def __init__(self, shape: Any, radius: float, pieces: Sequence[tuple[float, Callable[[Array], Array]]]) -> None:
        self._shape, self._radius, self._pieces = shape, radius, pieces

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return contact points (n, 3) m, unit normals (n, 3) and spins (n,) rad at `times` (n,) s."""
        number = np.searchsorted([end for end, _ in self._pieces[:-1]], times)
        state = np.zeros((len(times), 4))
        for piece in np.unique(number):
            state[number == piece] = np.asarray(self._pieces[piece][1](times[number == piece])).T
        points, spins = state[:, :3], state[:, 3]
        if type(self._shape) in GRADIENTS:
            return points, np.array([compute_normal_and_curvature(p, self._shape)[0] for p in points]), spins
        normals = np.array([compute_center_normal(x, self._shape, find_feature(x, self._shape)) for x in points])
        return points - self._radius * normals, normals, spins


def roll_path(
    shape: Any,
    radius: float,
    center: ArrayLike,
    normal: ArrayLike,
    rate: Callable[[float], ArrayLike],
    duration: float = 1.0,
    steps: int = 10,
) -> Path:
    """Return the path of a fingertip that rolls without slip.

    radius         m      of the fingertip
    center  (3,)   m      of the fingertip at time 0
    normal  (3,)          unit normal below it
    rate           rad/s  angular velocity (3,) of the fingertip against the object at a time, in the object frame
    duration       s
    steps                 smallest number of steps. Between steps the path is interpolated to the seventh order, without
                          error control: a twentieth of a radian per step gives an error of 1e-15 of the radius
    """
    n, c = np.asarray(normal, float), np.asarray(center, float)
    if type(shape) not in GRADIENTS:
        return Path(shape, radius, split_at_edges(shape, radius, c, rate, duration, steps))

    def derivative(t: float, state: Array) -> Array:
        w = np.asarray(rate(t), float)
        n, bend = compute_normal_and_curvature(state[:3], shape)
        return np.append(np.linalg.solve(bend + np.eye(3) / radius, np.cross(w, n)), w @ n)

    complete = integrate(derivative, 0.0, duration, np.append(c - radius * n, 0.0), duration / steps)
    return Path(shape, radius, [(duration, complete.sol)])


def split_at_edges(
    shape: Any, radius: float, center: Array, rate: Callable[[float], ArrayLike], duration: float, steps: int
) -> list[tuple[float, Callable[[Array], Array]]]:
    """Return the path of the centre in pieces: over each face, edge or corner as if it continued, until its end."""
    pieces: list[tuple[float, Callable[[Array], Array]]] = []
    start, state, past = 0.0, np.append(center, 0.0), find_feature(center, shape)
    while start < duration:

        def derivative(t: float, y: Array, past: Array = past) -> Array:
            w, n = np.asarray(rate(t), float), compute_center_normal(y[:3], shape, past)
            return np.append(radius * np.cross(w, n), w @ n)

        leaving = [make_leaving_event(shape, past, i) for i in range(len(past))]
        piece = integrate(derivative, start, duration, state, duration / steps, leaving)
        start, state, past = float(piece.t[-1]), piece.y[:, -1], past.copy()
        pieces.append((start, piece.sol))
        for i, reached in enumerate(piece.t_events):
            if len(reached):
                past[i] = 0.0 if past[i] else np.sign(find_levels(state[:3], shape)[0][i])
    return pieces


def make_leaving_event(shape: Any, past: Array, i: int) -> Callable[[float, Array], float]:
    """Return the event, for scipy, that the centre leaves the feature `past` along the i-th of `find_levels`."""

    def beyond(_: float, state: Array) -> float:
        level, end = find_levels(state[:3], shape)
        return float((past[i] * level[i] if past[i] else abs(level[i])) - end[i])

    beyond.terminal, beyond.direction = True, -1.0 if past[i] else 1.0  # type: ignore[attr-defined]
    return beyond


def integrate(
    derivative: Callable[[float, Array], Array],
    begin: float,
    end: float,
    state: Array,
    longest: float,
    events: Sequence[Callable[[float, Array], float]] = (),
) -> Any:
    """Return scipy's interpolated solution of the eighth order, to 1e-13."""
    try:
        from scipy.integrate import solve_ivp
    except ImportError as error:
        raise ConfigError("the reference path needs scipy: pip install 'softfinger[accuracy]'") from error
    return solve_ivp(
        derivative, (begin, end), state, method="DOP853", rtol=1e-13, atol=1e-17, max_step=longest,
        dense_output=True, events=list(events) or None,
    )  # fmt: skip
