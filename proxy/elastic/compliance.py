"""Compliance of the surface of an elastic body: displacement of each patch under a load on each other patch.

A patch is a disc about a vertex of the surface. Its load is spread as (1 - s^2)^2, s the distance over the patch's
radius, and its displacement is the mean with the same weights. So the compliance does not depend on the volume mesh,
as that of a point load does, and is symmetric (Maxwell, Betti).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.elastic.solid import BLOCK, Doubles, Solid


def patch_loads(solid: Solid, centers: Doubles, normals: Doubles, radius_m: float) -> list[Any]:
    """Return three sparse matrices (N, n): nodal forces of 1 N along x, y, z on the patch about each of n centres.

    Parameters
    ----------
    solid
        Body with N unknowns.
    centers, normals
        (n, 3) m, and outward unit normals (n, 3): the patch does not reach through a thin body.
    radius_m
        Radius of the patches.

    Raises
    ------
    ValueError
        If the surface has no quadrature point near a centre.
    """
    import skfem
    from scipy.sparse import csr_matrix
    from scipy.spatial import cKDTree

    mesh = solid.basis.mesh
    scalar = skfem.FacetBasis(mesh, skfem.ElementTetP2(), intorder=8)
    points = np.asarray(scalar.global_coordinates())  # (3, facets, quadrature points)
    _, facets, each = points.shape
    places = points.reshape(3, -1).T
    outward = np.broadcast_to(np.asarray(scalar.normals), points.shape).reshape(3, -1).T
    area = np.broadcast_to(scalar.dx, (facets, each)).ravel()
    shares = csr_matrix((scalar.N, facets * each))
    columns = np.arange(facets * each)
    for local, dofs in enumerate(scalar.element_dofs):
        values = np.broadcast_to(np.asarray(scalar.basis[local][0]), (facets, each)).ravel()
        shares = shares + csr_matrix((values * area, (np.repeat(dofs, each), columns)), shape=shares.shape)
    rows, weights, owners = [], [], []
    for number, near in enumerate(cKDTree(places).query_ball_point(centers, radius_m)):
        chosen = np.asarray(near, np.int64)
        chosen = chosen[outward[chosen] @ normals[number] > 0.0] if len(chosen) else chosen
        squared = ((places[chosen] - centers[number]) ** 2).sum(axis=1) / radius_m**2
        weight = (1.0 - squared) ** 2
        total = (weight * area[chosen]).sum()
        if not total > 0.0:
            raise ValueError(f"patch_radius_m = {radius_m:g}: a patch has no surface: take a larger one")
        rows.append(chosen)
        weights.append(weight / total)
        owners.append(np.full(len(chosen), number))
    spread = csr_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(owners))), shape=(len(places), len(centers))
    )
    loads = (shares @ spread).tocoo()
    return [
        csr_matrix(
            (loads.data, (_component(solid, scalar, axis)[loads.row], loads.col)), shape=(solid.basis.N, len(centers))
        )
        for axis in range(3)
    ]


def _component(solid: Solid, scalar: Any, axis: int) -> NDArray[np.int64]:
    """Return the unknown of the vector basis for each unknown of the scalar one."""
    place = np.empty(scalar.N, np.int64)
    place[scalar.nodal_dofs[0]] = solid.basis.nodal_dofs[axis]
    place[scalar.edge_dofs[0]] = solid.basis.edge_dofs[axis]
    return place


def compliance(solid: Solid, loads: list[Any], done: Callable[[int], None] = lambda number: None) -> Doubles:
    """Return the compliance (n, n, 3, 3), m/N times 1 Pa.

    Element [a, b, i, j] is the displacement i of patch a under the load j on patch b.

    `done` is called with the number of solved right-hand sides, out of 3 n.
    """
    from scipy.sparse import hstack

    count = loads[0].shape[1]
    together = hstack(loads).tocsc()  # component by component
    found = np.empty((3 * count, 3 * count))
    back = together.T.tocsr()
    for start in range(0, 3 * count, BLOCK):
        part = slice(start, min(start + BLOCK, 3 * count))
        found[:, part] = back @ solid.solve(together[:, part].toarray())
        done(part.stop)
    found += found.T.copy()
    found *= 0.5
    return np.ascontiguousarray(found.reshape(3, count, 3, count).transpose(1, 3, 0, 2))


def vertex_normals(vertices: Doubles, triangles: NDArray[np.int64]) -> Doubles:
    """Return the mean outward unit normal (n, 3) at each vertex, weighted by area; zero at unused vertices."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.zeros(vertices.shape)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], np.cross(b - a, c - a))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    found: Doubles = normals / np.where(length > 0.0, length, 1.0)
    return found
