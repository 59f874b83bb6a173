"""A mesh with fewer triangles, for pictures: vertices of a cell become one, in their middle."""

from __future__ import annotations

from typing import Final

import numpy as np

from softfinger.proxy.meshes.pieces import first_alike
from softfinger.proxy.meshes.reading import Arrays

PICTURE_TRIANGLES: Final = 50_000
"""A page draws them 30 times a second, without a graphics card too; sent they are one megabyte."""
FINEST: Final = 1e-6
"""Least size of a cell, of the mesh's: a needle's box has hardly a surface."""
_COARSER: Final = 1.1


def thinned(mesh: Arrays, most: int = PICTURE_TRIANGLES) -> Arrays:
    """The mesh with at most so many triangles; the same where it has no more.

    Its cells are as large as that needs. What is smaller than one goes: this is no mesh to touch.
    """
    edges = np.ptp(mesh.vertices, axis=0)
    around = 2.0 * float(edges @ np.roll(edges, 1))
    cell = max(float(np.sqrt(3.0 * around / most)), FINEST * float(edges.max()))
    thin = mesh
    while len(thin.triangles) > most:
        thin = _clustered(mesh, cell)
        cell *= max(_COARSER, float(np.sqrt(len(thin.triangles) / most)))
    return thin


def _clustered(mesh: Arrays, cell: float) -> Arrays:
    at = ((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.uint32)
    first = first_alike(at)
    stays = first == np.arange(len(first))
    place = (np.cumsum(stays, dtype=np.int32) - np.int32(1))[first]
    counts = np.bincount(place)
    middles = np.stack([np.bincount(place, mesh.vertices[:, axis]) / counts for axis in range(3)], axis=1)
    triangles = place[mesh.triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    first = first_alike(np.sort(triangles, axis=1).view(np.uint32))
    return Arrays(middles, np.ascontiguousarray(triangles[first == np.arange(len(first))]))
