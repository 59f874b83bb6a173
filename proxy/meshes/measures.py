"""Compiled functions for areas and volumes of triangles: NumPy arrays of all edges of millions would take gigabytes."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics.vec3 import cross, dot, sub

Numbers = NDArray[np.float64]
Indices = NDArray[np.int32]


@entry
def mark_flat(vertices: Numbers, triangles: Indices, flatness: float, flat: NDArray[np.bool_]) -> None:
    """Mark the triangles (m, 3) with a height of at most `flatness` times their longest edge."""
    for i in range(len(triangles)):
        a, b, c = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        p = (vertices[a, 0], vertices[a, 1], vertices[a, 2])
        u = sub((vertices[b, 0], vertices[b, 1], vertices[b, 2]), p)
        v = sub((vertices[c, 0], vertices[c, 1], vertices[c, 2]), p)
        w = sub(v, u)
        longest = sqrt(max(dot(u, u), dot(v, v), dot(w, w)))
        scale = 1.0 / longest if longest > 0.0 else 0.0  # the square of a small area would underflow to zero
        n = cross((scale * u[0], scale * u[1], scale * u[2]), (scale * v[0], scale * v[1], scale * v[2]))
        flat[i] = not sqrt(dot(n, n)) > flatness


@entry
def add_volumes(vertices: Numbers, triangles: Indices, middle: Numbers, body: Indices, volumes: Numbers) -> None:
    """Add to each body (bodies,) the signed volume, m^3, of the tetrahedra from `middle` (3,) to its triangles.

    vertices (n, 3) m, triangles (m, 3), body (m,) of each triangle
    """
    o = (middle[0], middle[1], middle[2])
    for i in range(len(triangles)):
        a, b, c = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        p = sub((vertices[a, 0], vertices[a, 1], vertices[a, 2]), o)
        q = sub((vertices[b, 0], vertices[b, 1], vertices[b, 2]), o)
        r = sub((vertices[c, 0], vertices[c, 1], vertices[c, 2]), o)
        volumes[body[i]] += dot(p, cross(q, r)) / 6.0
