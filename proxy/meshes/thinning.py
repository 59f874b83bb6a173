"""Simplification of a mesh for pictures: the vertices in each cell of a grid are replaced by their mean."""

from __future__ import annotations

from typing import Final

import numpy as np

from softfinger.proxy.meshes.pieces import find_unique_rows, find_unique_triangles
from softfinger.proxy.meshes.reading import Arrays

PICTURE_TRIANGLES: Final = 50_000
"""The page draws this many 30 times a second even without a graphics card; they are one megabyte on the wire."""
MIN_CELL_SHARE: Final = 1e-6
"""Smallest cell size, as a fraction of the mesh's: the bounding box of a needle has almost no surface."""
_COARSENING: Final = 1.1


def thin_mesh(mesh: Arrays, most: int = PICTURE_TRIANGLES) -> Arrays:
    """Return the mesh with at most `most` triangles; the same mesh if it has no more.

    The cell size is as small as that allows. Details smaller than a cell vanish: the result is only for pictures.
    """
    edges = np.ptp(mesh.vertices, axis=0)
    around = 2.0 * float(edges @ np.roll(edges, 1))
    cell = max(float(np.sqrt(3.0 * around / most)), MIN_CELL_SHARE * float(edges.max()))
    thin = mesh
    while len(thin.triangles) > most:
        thin = _cluster_vertices(mesh, cell)
        cell *= max(_COARSENING, float(np.sqrt(len(thin.triangles) / most)))
    return thin


def _cluster_vertices(mesh: Arrays, cell: float) -> Arrays:
    at = ((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.uint32)
    _, place = find_unique_rows(at)
    counts = np.bincount(place)
    middles = np.stack([np.bincount(place, mesh.vertices[:, axis]) / counts for axis in range(3)], axis=1)
    triangles = place[mesh.triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    return Arrays(middles, triangles[find_unique_triangles(triangles)])
