"""Distances of points from all triangles of a mesh, in float64, by the formula of `triangles.py`; nothing is shared
with the kernels. A triangle is skipped only if its bounding ball is farther than a corner of another, which is exact.
Compiled and cached, for a million points on fifty thousand triangles."""

from math import inf, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from references.rotation import Array
from references.triangles import distances
from softfinger.proxy.kernels.jit.decorators import PLAIN, entry, jit

SLACK = 1e-9
"""Share by which a bounding ball is taken for larger than it is: rounding."""


class Balls(NamedTuple):
    """Corners (m, 3, 3) m of triangles, and balls round them: middles (m, 3) m and radii (m,) m."""

    corners: Array
    middles: Array
    radii: Array


def balls_of(vertices: ArrayLike, triangles: ArrayLike) -> Balls:
    corners = np.ascontiguousarray(np.asarray(vertices, np.float64)[np.asarray(triangles)])
    middles = corners.mean(axis=1)
    return Balls(corners, middles, np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1) * (1.0 + SLACK))


@jit
def _segment(x: Any, a: Any, b: Any) -> float:
    """Distance squared of `x` (3,) from a segment."""
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ax0, ax1, ax2 = x[0] - a[0], x[1] - a[1], x[2] - a[2]
    square, share = ab0 * ab0 + ab1 * ab1 + ab2 * ab2, 0.0
    if square > 0.0:
        share = min(max((ab0 * ax0 + ab1 * ax1 + ab2 * ax2) / square, 0.0), 1.0)
    d0, d1, d2 = ax0 - share * ab0, ax1 - share * ab1, ax2 - share * ab2
    return d0 * d0 + d1 * d1 + d2 * d2


@jit
def _side(x: Any, a: Any, b: Any, n: Any) -> float:
    """Above 0 where `x` is on the inner side of the edge from a to b of a triangle with the normal `n`."""
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ax0, ax1, ax2 = x[0] - a[0], x[1] - a[1], x[2] - a[2]
    return (
        (ab1 * ax2 - ab2 * ax1) * n[0] + (ab2 * ax0 - ab0 * ax2) * n[1] + (ab0 * ax1 - ab1 * ax0) * n[2]
    )  # fmt: skip


@jit
def _triangle(x: Any, t: Any) -> float:
    """Distance of `x` (3,) from a triangle (3, 3): of its plane over it, of its edges elsewhere."""
    a, b, c = t[0], t[1], t[2]
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n = (u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0)
    size = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    nearest = sqrt(min(_segment(x, a, b), _segment(x, b, c), _segment(x, c, a)))
    if size > 0.0 and _side(x, a, b, n) >= 0.0 and _side(x, b, c, n) >= 0.0 and _side(x, c, a, n) >= 0.0:
        above = ((x[0] - a[0]) * n[0] + (x[1] - a[1]) * n[1] + (x[2] - a[2]) * n[2]) / size
        nearest = min(nearest, abs(above))
    return nearest


@entry
def _distances(balls: Balls, points: Any, out: Any) -> None:
    corners, middles, radii = balls
    for i in range(len(points)):
        x = points[i]
        bound = inf
        for k in range(len(middles)):
            d0, d1, d2 = x[0] - corners[k, 0, 0], x[1] - corners[k, 0, 1], x[2] - corners[k, 0, 2]
            bound = min(bound, d0 * d0 + d1 * d1 + d2 * d2)
        best = sqrt(bound) * (1.0 + SLACK)
        for k in range(len(middles)):
            d0, d1, d2 = x[0] - middles[k, 0], x[1] - middles[k, 1], x[2] - middles[k, 2]
            reach = best + radii[k]
            if d0 * d0 + d1 * d1 + d2 * d2 <= reach * reach * (1.0 + SLACK):
                best = min(best, _triangle(x, corners[k]))
        out[i] = best


def brute_distances(balls: Balls, points: ArrayLike) -> Array:
    """Distances (n,) m of `points` (n, 3) m from the nearest triangle."""
    places = np.ascontiguousarray(points, np.float64)
    out = np.empty(len(places))
    if PLAIN:
        vertices = balls.corners.reshape(-1, 3)
        triangles = np.arange(len(vertices)).reshape(-1, 3)
        return np.array([distances(vertices, triangles, x).min() for x in places])
    _distances(balls, places, out)
    return out
