"""Winding of the triangles of a mesh: consistent within each piece, and outward if the piece has an outside."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.meshes.pieces import Edges, find_pieces, iter_corner_blocks
from softfinger.proxy.meshes.reading import Arrays, Triangles, Vertices

TESTED_PIECES: Final = 16
"""Number of largest pieces that are tested for containing a hollow."""


class Winding(NamedTuple):
    """Triangles (m, 3) int32 with corrected winding.

    bodies     pieces connected over edges of two triangles
    alike      triangles turned because they were wound against their neighbours
    outward    triangles turned because their piece was wound inward
    hollows    pieces that keep their inward winding, as walls of a hollow within another piece
    one_sided  pieces without a consistent winding
    volume     m^3, of pieces without open edges, minus hollows
    """

    triangles: Triangles
    bodies: int
    alike: int
    outward: int
    hollows: int
    one_sided: int
    volume: float


def wind(mesh: Arrays, edges: Edges) -> Winding:
    """Wind the triangles of a mesh (m) consistently within each piece, with the front outside."""
    pieces = find_pieces(edges)
    bodies = len(pieces.one_sided)
    against = np.bincount(pieces.body, pieces.turned, bodies)
    most = 2.0 * against > np.bincount(pieces.body, minlength=bodies)
    turned = (pieces.turned ^ most[pieces.body]) & ~pieces.one_sided[pieces.body]
    triangles = _reverse(mesh.triangles, turned)
    closed = ~pieces.one_sided
    # An edge without exactly two triangles is a boundary of all pieces that it belongs to.
    rim = (edges.counts[edges.first] != 2).nonzero()[0] // 3
    closed[pieces.body[rim]] = False
    volumes = np.zeros(bodies)
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    for block, (a, b, c) in iter_corner_blocks(mesh.vertices - middle, triangles):
        np.add.at(volumes, pieces.body[block], (a * np.cross(b, c)).sum(axis=1) / 6.0)
    volumes[~closed] = 0.0
    hollow = _find_hollows(mesh.vertices, triangles, pieces.body, volumes)
    inward = (volumes < 0.0) & ~hollow
    volumes[inward] *= -1.0
    outward = inward[pieces.body]
    return Winding(
        _reverse(triangles, outward),
        bodies=bodies,
        alike=int(turned.sum()),
        outward=int(outward.sum()),
        hollows=int(hollow.sum()),
        one_sided=int(pieces.one_sided.sum()),
        volume=float(volumes.sum()),
    )


def _reverse(triangles: Triangles, which: NDArray[np.bool_]) -> Triangles:
    if not which.any():
        return triangles
    reversed_triangles = triangles.copy()
    reversed_triangles[which, 1], reversed_triangles[which, 2] = triangles[which, 2], triangles[which, 1]
    return reversed_triangles


def _find_hollows(
    vertices: Vertices, triangles: Triangles, body: NDArray[np.int32], volumes: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which pieces (bodies,) are hollows.

    A hollow is wound inward, and its bounding box is within that of one of the largest pieces wound outward.
    """
    hollow = np.zeros(len(volumes), np.bool_)
    if not (volumes < 0.0).any() or not (volumes > 0.0).any():
        return hollow
    low, high = np.full((len(volumes), 3), np.inf), np.full((len(volumes), 3), -np.inf)
    for corner in range(3):
        np.minimum.at(low, body, vertices[triangles[:, corner]])
        np.maximum.at(high, body, vertices[triangles[:, corner]])
    for holder in np.argsort(-volumes)[:TESTED_PIECES]:
        if volumes[holder] > 0.0:
            hollow |= (volumes < 0.0) & ((low > low[holder]) & (high < high[holder])).all(axis=1)
    return hollow
