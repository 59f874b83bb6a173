"""Faces as files have them, and their triangles.

Readers of the formats return `Faces`; `proxy.meshes.reading` checks them and calls `triangulate`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Indices = NDArray[np.int64]

CONCAVE_MAX: Final = 2_000_000
"""Largest sum of squared corner counts of concave faces: cutting their ears takes a minute at most."""
FLAT_AREA_SHARE: Final = 1e-9
"""Relative area of a triangle wound against its face that counts as rounding."""


class Faces(NamedTuple):
    """Polygons of a file.

    points    (n, 3) vertices, unit of the file
    corners   (sum of counts,) indices of vertices, face by face
    counts    (faces,) corners of each face
    promised  number of faces that the file states or that a count of its statements gives
    """

    points: Points
    corners: Indices
    counts: Indices
    promised: int


def require_triangles(points: Points, triangles: Indices, promised: int) -> Faces:
    """Return the faces of a mesh of triangles (m, 3)."""
    return Faces(points, triangles.reshape(-1), np.full(len(triangles), 3, np.int64), promised)


def split_strip(corners: Indices) -> Indices:
    """Return the triangles (k - 2, 3) of a strip of k corners; every second one is turned: all face one side."""
    triangles = np.lib.stride_tricks.sliding_window_view(corners, 3) if len(corners) > 2 else np.empty((0, 3), np.int64)
    triangles = triangles.copy()
    triangles[1::2] = triangles[1::2, ::-1]
    return triangles


def triangulate(faces: Faces) -> Indices:
    """Return the triangles (m, 3) of all faces, wound like them.

    A face of k corners gives k - 2 triangles, as a fan from its first corner if it is convex. A face of one or two
    corners gives a triangle without area, which the caller drops. Raises ValueError for too many concave faces.
    """
    if (faces.counts == 3).all():
        return faces.corners.reshape(-1, 3)
    starts = np.cumsum(faces.counts) - faces.counts
    filled = faces.counts > 0
    starts, counts = starts[filled], faces.counts[filled]
    rows = np.maximum(counts - 2, 1)
    face = np.repeat(np.arange(len(counts)), rows)
    step = np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows)
    last = counts[face] - 1
    places = np.stack([np.zeros_like(step), np.minimum(step + 1, last), np.minimum(step + 2, last)], axis=1)
    triangles: Indices = faces.corners[starts[face][:, None] + places]
    for number in _find_concave(faces.points, triangles, face, counts):
        corners = faces.corners[starts[number] : starts[number] + counts[number]]
        triangles[np.searchsorted(face, number) :][: len(corners) - 2] = _cut_ears(faces.points, corners)
    return triangles


def _find_concave(points: Points, triangles: Indices, face: Indices, counts: Indices) -> list[int]:
    """Return the faces with a triangle in their fan that is wound against the face."""
    many = counts[face] > 3
    owner, (a, b, c) = face[many], (points[triangles[many, corner]] for corner in range(3))
    with np.errstate(all="ignore"):  # coordinates that are not finite are refused by the caller
        areas = np.cross(b - a, c - a)
        normals = np.stack([np.bincount(owner, areas[:, axis], len(counts)) for axis in range(3)], axis=1)[owner]
        against = (areas * normals).sum(axis=1) < -FLAT_AREA_SHARE * (normals * normals).sum(axis=1)
    concave = np.unique(owner[against])
    if (counts[concave] ** 2).sum() > CONCAVE_MAX:
        raise ValueError(f"has {len(concave):,} concave faces, too many to triangulate: export it as triangles")
    return [int(index) for index in concave]


def _cut_ears(points: Points, corners: Indices) -> Indices:
    """Return the triangles (k - 2, 3) of a concave face of k corners, by cutting ears off.

    A face that crosses itself has no right division: a remainder without ears becomes a fan.
    """
    outline = points[corners]
    normal = np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = outline[:, [(axis + 1) % 3, (axis + 2) % 3]] * (1.0 if normal[axis] > 0.0 else -1.0, 1.0)
    remaining, ears = list(range(len(corners))), []
    while len(remaining) > 3:
        at = next((k for k in range(len(remaining)) if _is_ear(flat, remaining, k)), 1)
        ears.append([remaining[at - 1], remaining[at], remaining[(at + 1) % len(remaining)]])
        del remaining[at]
    return np.asarray(corners[np.array([*ears, remaining])])


def _is_ear(flat: Points, remaining: list[int], at: int) -> bool:
    """Return True if the corner `at` of the polygon `remaining` can be cut off: convex, with no other corner inside."""
    before, here, after = remaining[at - 1], remaining[at], remaining[(at + 1) % len(remaining)]
    a, b, c = flat[before], flat[here], flat[after]
    if _turn(a, b, c) <= 0.0:
        return False
    others = flat[[k for k in remaining if k not in (before, here, after)]]
    within = (_turn(a, b, others) >= 0.0) & (_turn(b, c, others) >= 0.0) & (_turn(c, a, others) >= 0.0)
    # A corner of the same place is the other end of a bridge to a hole.
    same = (others[:, None] == np.stack([a, b, c])).all(axis=2).any(axis=1)
    return not (within & ~same).any()


def _turn(a: Points, b: Points, c: Points) -> Points:
    """Return twice the signed area of the triangles a, b, c: positive if they turn left."""
    ab, ac = b - a, c - a
    return np.asarray(ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0])
