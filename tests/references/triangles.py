"""Distances from triangles, with a separate formula for the plane and for the edges."""

import numpy as np


def segment_distances(x, a, b):
    """Distances (m,) of `x` (3,) from segments a, b (m, 3)."""
    along = b - a
    square = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", x - a, along) / np.where(square > 0.0, square, 1.0)
    return np.linalg.norm(x - a - np.clip(share, 0.0, 1.0)[:, None] * along, axis=1)


def distances(vertices, triangles, x):
    """Distances (m,) of `x` (3,) from triangles: that of the plane where the foot is inside, else of the edges."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    unit = normal / np.where(size > 0.0, size, 1.0)[:, None]
    above = np.einsum("ij,ij->i", x - a, unit)
    foot = x - above[:, None] * unit
    inside = size > 0.0
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ij,ij->i", np.cross(q - p, foot - p), unit) >= 0.0
    edges = np.minimum.reduce([segment_distances(x, p, q) for p, q in ((a, b), (b, c), (c, a))])
    return np.where(inside, np.minimum(np.abs(above), edges), edges)
