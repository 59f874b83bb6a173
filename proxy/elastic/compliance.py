"""Compliance of the surface of an elastic body: displacement of each patch under a load on each other patch.

A patch is a disc about a vertex of the surface. Its load is spread as (1 - s^2)^2, s the distance over the patch's
radius, and its displacement is the mean with the same weights. So the compliance does not depend on the volume mesh,
as that of a point load does, and is symmetric (Maxwell, Betti).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.elastic.solid import Doubles, Solid

SOLVE_BLOCK: Final = 128
"""Right-hand sides that are solved together."""
GRADIENT_BLOCK: Final = 16
"""Number of right-hand sides whose displacement gradients are in memory together."""


def make_patch_loads(solid: Solid, centers: Doubles, normals: Doubles, radius_m: float) -> list[Any]:
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
    _, facets, points_per_facet = points.shape
    places = points.reshape(3, -1).T
    outward = np.broadcast_to(np.asarray(scalar.normals), points.shape).reshape(3, -1).T
    area = np.broadcast_to(scalar.dx, (facets, points_per_facet)).ravel()
    shares = csr_matrix((scalar.N, facets * points_per_facet))
    columns = np.arange(facets * points_per_facet)
    for local, dofs in enumerate(scalar.element_dofs):
        values = np.broadcast_to(np.asarray(scalar.basis[local][0]), (facets, points_per_facet)).ravel()
        shares = shares + csr_matrix((values * area, (np.repeat(dofs, points_per_facet), columns)), shape=shares.shape)
    rows, weights, owners = [], [], []
    for number, near in enumerate(cKDTree(places).query_ball_point(centers, radius_m)):
        chosen = np.asarray(near, np.int64)
        chosen = chosen[outward[chosen] @ normals[number] > 0.0] if len(chosen) else chosen
        squared = ((places[chosen] - centers[number]) ** 2).sum(axis=1) / radius_m**2
        weight = (1.0 - squared) ** 2
        total = (weight * area[chosen]).sum()
        if not total > 0.0:
            raise ValueError(
                f"patch_radius_m = {radius_m:g}: a patch contains no surface: increase it, or check `scale`"
            )
        rows.append(chosen)
        weights.append(weight / total)
        owners.append(np.full(len(chosen), number))
    spread = csr_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(owners))), shape=(len(places), len(centers))
    )
    loads = (shares @ spread).tocoo()
    return [
        csr_matrix(
            (loads.data, (_select_component(solid, scalar, axis)[loads.row], loads.col)),
            shape=(solid.basis.N, len(centers)),
        )
        for axis in range(3)
    ]


def _select_component(solid: Solid, scalar: Any, axis: int) -> NDArray[np.int64]:
    """Return the unknown of the vector basis for each unknown of the scalar one."""
    place = np.empty(scalar.N, np.int64)
    place[scalar.nodal_dofs[0]] = solid.basis.nodal_dofs[axis]
    place[scalar.edge_dofs[0]] = solid.basis.edge_dofs[axis]
    return place


class Solution(NamedTuple):
    """Response of a body of Young's modulus 1 Pa to unit loads on its n patches.

    compliance  (n, n, 3, 3) m/N  element [a, b, i, j] is the displacement i of patch a under the load j on patch b
    bending     (n, 3, 2) 1/N     largest rotation, rad, and largest strain in a tetrahedron at the surface, under each
                                  load: norms of the two parts of the mean gradient of the displacement
    """

    compliance: Doubles
    bending: Doubles


def solve_patches(solid: Solid, loads: list[Any], advance: Callable[[int], None] = lambda number: None) -> Solution:
    """Solve for unit loads on all patches; `advance` is called with the number of solved loads, out of 3 n."""
    from scipy.sparse import hstack

    count = loads[0].shape[1]
    together = hstack(loads).tocsr()[solid.free].tocsc()  # component by component
    blocks, bending = np.empty((count, count, 3, 3)), np.empty((2, 3 * count))
    back, gradient = together.T, make_surface_gradient(solid)[:, solid.free]
    # Loads with the same first fronts are solved together: the fronts before these are skipped.
    first = np.minimum.reduceat(solid.factors.number[together.indices], together.indptr[:-1])
    parts = np.array_split(np.argsort(first, kind="stable"), -(-3 * count // SOLVE_BLOCK))

    def solve(part: NDArray[np.int64]) -> None:
        moved = together[:, part].toarray()
        solid.factors.solve(moved)
        axis, patch = np.divmod(part, count)
        blocks.transpose(2, 0, 3, 1)[:, :, axis, patch] = (back @ moved).reshape(3, count, len(part))
        for strip in range(0, len(part), GRADIENT_BLOCK):
            bending[:, part[strip : strip + GRADIENT_BLOCK]] = find_largest_rotation_and_strain(
                gradient, moved[:, strip : strip + GRADIENT_BLOCK]
            )

    solved = 0
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:  # the kernels release the interpreter lock
        for part, _ in zip(parts, threads.map(solve, parts), strict=True):
            solved += len(part)
            advance(solved)
    for patch in range(count):
        later = blocks[patch, patch:]
        later[:] = 0.5 * (later + blocks[patch:, patch].transpose(0, 2, 1))
        blocks[patch:, patch] = later.transpose(0, 2, 1)
    return Solution(blocks, bending.reshape(2, 3, count).transpose(2, 1, 0))


def make_surface_gradient(solid: Solid) -> Any:
    """Return the sparse matrix (9 m, N) of the mean displacement gradients [k, i, j] = du_i / dx_j.

    It is that of the m tetrahedra with a face on the surface.
    """
    from scipy.sparse import csr_matrix

    mesh = solid.basis.mesh
    outer = np.unique(mesh.f2t[0, mesh.boundary_facets()])
    corners = mesh.t[:, outer]
    edges = mesh.p[:, corners[1:]] - mesh.p[:, corners[:1]]  # (3, 3, m): component, edge
    inner = np.linalg.inv(edges.transpose(2, 1, 0))  # (m, 3, 3): column of each corner but the first
    slopes = np.concatenate([-inner.sum(axis=2, keepdims=True), inner], axis=2)  # (m, j, corner)
    tetrahedron = np.arange(len(outer))
    rows, columns, values = [], [], []
    for i, j, corner in np.ndindex(3, 3, 4):
        rows.append(9 * tetrahedron + 3 * i + j)
        columns.append(solid.basis.nodal_dofs[i, corners[corner]])
        values.append(slopes[:, j, corner])
    indices = np.concatenate(rows), np.concatenate(columns)
    return csr_matrix((np.concatenate(values), indices), shape=(9 * len(outer), solid.basis.N))


def find_largest_rotation_and_strain(gradient: Any, moved: Doubles) -> Doubles:
    """Return the largest rotation, rad, and strain of each of the displacements (N, k): (2, k)."""
    g = (gradient @ moved).reshape(-1, 3, 3, moved.shape[1])
    mirrored = g.transpose(0, 2, 1, 3)
    strain = np.sqrt((((g + mirrored) * 0.5) ** 2).sum(axis=(1, 2)))
    rotation = np.sqrt((((g - mirrored) * 0.5) ** 2).sum(axis=(1, 2)) * 0.5)
    return np.stack([rotation.max(axis=0), strain.max(axis=0)])


def compute_vertex_normals(vertices: Doubles, triangles: NDArray[np.int64]) -> Doubles:
    """Return the mean outward unit normal (n, 3) at each vertex, weighted by area; zero at unused vertices."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.zeros(vertices.shape)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], np.cross(b - a, c - a))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit_normals: Doubles = normals / np.where(length > 0.0, length, 1.0)
    return unit_normals
