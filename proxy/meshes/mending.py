"""Repair of a mesh without a change of its shape; `report.py` describes the repairs and the remaining faults.

Coincident vertices are merged. Triangles without area, duplicate triangles and unused vertices are removed. Triangles
wound against their neighbours are turned. Holes are not filled, and intersecting triangles are not searched for.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits
from softfinger.proxy.meshes.pieces import find_unique_rows, find_unique_triangles, iter_corner_blocks, list_edges
from softfinger.proxy.meshes.reading import Arrays, Triangles, Vertices
from softfinger.proxy.meshes.winding import Winding, wind

MERGE_DISTANCE_SHARE: Final = 1e-9
"""Merging distance as a fraction of the mesh's size. The repeated vertices of an STL file are within it."""
FLAT_HEIGHT_SHARE: Final = 1e-12
"""Height over the longest edge below which a triangle has no area: float64 cannot resolve its normal."""


class RepairedMesh(NamedTuple):
    """Repaired mesh, m, and counts of repairs and of remaining faults.

    merged, unused              vertices
    degenerate, duplicate       removed triangles
    open_edges, crowded_edges   edges of one triangle, and of more than two
    winding                     pieces, and how they were turned
    """

    arrays: Arrays
    merged: int
    unused: int
    degenerate: int
    duplicate: int
    open_edges: int
    crowded_edges: int
    winding: Winding

    @property
    def watertight(self) -> bool:
        """True if the mesh has an inside: each edge has two triangles with consistent winding."""
        return self.open_edges == self.crowded_edges == self.winding.one_sided == 0


def mend(arrays: Arrays, loose: bool) -> RepairedMesh:
    """Repair a mesh (m), and wind its triangles; `loose` merges vertices within MERGE_DISTANCE_SHARE of its size.

    Parameters
    ----------
    arrays
        Vertices, m, finite, and triangles with valid indices.
    loose
        Merge vertices within MERGE_DISTANCE_SHARE of the mesh's size, not only equal ones.

    Returns
    -------
    RepairedMesh
        Repaired mesh, with counts of repairs and of remaining faults.

    Raises
    ------
    ValueError
        If the mesh is too small, too large or too far from its origin, or if no triangle has an area.
    """
    vertices, triangles = arrays
    used, triangles = _drop_unused_vertices(arrays)
    unused = len(vertices) - len(used)
    vertices = vertices[used]
    _check_size(vertices)

    unique, renumbered = _merge_vertices(vertices, loose)
    merged = len(vertices) - len(unique)
    vertices, triangles = vertices[unique], renumbered[triangles]

    flat = _is_flat(vertices, triangles)
    triangles = triangles[~flat]
    unique_corners = find_unique_triangles(triangles)
    duplicate, triangles = len(triangles) - len(unique_corners), triangles[unique_corners]
    if len(triangles) == 0:
        raise ValueError(f"has no triangle with an area: all {len(flat):,} are points or lines")

    used_vertices, triangles = _drop_unused_vertices(Arrays(vertices, triangles))
    vertices = vertices[used_vertices]
    edges = list_edges(triangles)
    winding = wind(Arrays(vertices, triangles), edges)
    return RepairedMesh(
        Arrays(np.ascontiguousarray(vertices), winding.triangles),
        merged=merged,
        unused=unused,
        degenerate=int(flat.sum()),
        duplicate=duplicate,
        open_edges=int((edges.counts == 1).sum()),
        crowded_edges=int((edges.counts > 2).sum()),
        winding=winding,
    )


def _is_flat(vertices: Vertices, triangles: Triangles) -> NDArray[np.bool_]:
    """Return which triangles (m, 3) have a height of at most FLAT_HEIGHT_SHARE times their longest edge."""
    flat = np.empty(len(triangles), np.bool_)
    for block, (a, b, c) in iter_corner_blocks(vertices, triangles):
        u, v = b - a, c - a
        longest = np.sqrt(np.max([(edge * edge).sum(axis=1) for edge in (u, v, v - u)], axis=0))
        # The square of a small area would underflow to zero.
        scale = np.divide(1.0, longest, out=np.zeros_like(longest), where=longest > 0.0)[:, None]
        flat[block] = ~(np.linalg.norm(np.cross(scale * u, scale * v), axis=1) > FLAT_HEIGHT_SHARE)
    return flat


def _check_size(vertices: Vertices) -> None:
    low, high = _find_extent(vertices)
    size, reach = _size(vertices), max(map(abs, low + high))
    if not limits.MESH_SIZE_M.low <= size <= limits.MESH_SIZE_M.high:
        raise ValueError(
            f"is {size:g} m in size, must be {limits.MESH_SIZE_M.low:g} to {limits.MESH_SIZE_M.high:g}: set `scale` "
            "to the metres per unit of the file, 0.001 for millimetres"
        )
    if reach > limits.COORDINATE_M.high:
        raise ValueError(
            f"has a coordinate of {reach:g} m, at most {limits.COORDINATE_M.high:g} is allowed: move it to the "
            "origin, and use position_m"
        )


def _find_extent(vertices: Vertices) -> tuple[list[float], list[float]]:
    """Return the minimum and maximum of each coordinate; column by column takes NumPy a tenth of the time."""
    columns = vertices.T
    return [float(column.min()) for column in columns], [float(column.max()) for column in columns]


def _size(vertices: Vertices) -> float:
    return max(high - low for low, high in zip(*_find_extent(vertices), strict=True))


def _drop_unused_vertices(arrays: Arrays) -> tuple[NDArray[np.int64], Triangles]:
    """Return the indices of the used vertices, and the triangles (m, 3) as indices into these."""
    is_used = np.zeros(len(arrays.vertices), np.bool_)
    is_used[arrays.triangles.ravel()] = True
    place = np.cumsum(is_used, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(is_used), place[arrays.triangles]


def _merge_vertices(vertices: Vertices, loose: bool) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the indices of the vertices to keep, and the new index of each vertex."""
    unique, place = find_unique_rows((vertices + 0.0).view(np.uint64))  # + 0.0 turns -0.0 into 0.0
    if not loose:
        return unique, place
    tolerance = MERGE_DISTANCE_SHARE * _size(vertices)
    steps = np.stack([_label_groups(vertices[unique, axis], tolerance) for axis in range(3)], axis=1)
    clustered, number = find_unique_rows(steps)
    return unique[clustered], number[place]


def _label_groups(values: NDArray[np.float64], tolerance: float) -> NDArray[np.uint32]:
    """Return a label for each value; values share a label if no gap between them exceeds the tolerance."""
    order = np.argsort(values)
    number = np.empty(len(values), np.uint32)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > tolerance)])
    return number
