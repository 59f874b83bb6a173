"""Tree over the triangles of a mesh, with their neighbours and normals, as the kernels of a tick use it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.shapes.mesh import build
from softfinger.proxy.kernels.shapes.mesh.lanes import LANES, NODE
from softfinger.proxy.meshes.pieces import iter_corner_blocks, list_edges

Doubles = NDArray[np.float64]
Whole = NDArray[np.int32]


class Tree(NamedTuple):
    """Arrays and numbers of a `model.Mesh`; the triangles are the given ones in another order.

    closed  True if each edge has two triangles with consistent winding
    """

    nodes: NDArray[np.float32]
    first: Whole
    vertices: Doubles
    corners: Whole
    across: Whole
    upward: Doubles
    center: Doubles
    size: float
    closed: bool


def build_tree(vertices: Doubles, triangles: Whole) -> Tree:
    """Return the tree over `triangles` (m, 3) of `vertices` (n, 3) m."""
    columns = [vertices[:, axis] for axis in range(3)]  # column by column: five times as fast
    least, most = np.array([x.min() for x in columns]), np.array([x.max() for x in columns])
    center, size = 0.5 * (least + most), float(np.sqrt(((most - least) ** 2).sum()))
    middles = np.empty((len(triangles), 3), np.float32)
    for block, (a, b, c) in iter_corner_blocks(vertices, triangles):
        middles[block] = a + b + c - 3.0 * center
    tree = make_branches(len(triangles))
    order, node = np.arange(len(triangles), dtype=np.int32), 0
    while node < len(tree.first):
        node = build.arrange(middles, order, tree, node)
    arranged, corners = arrange_vertices(vertices, triangles[order])
    middle, node = (float(center[0]), float(center[1]), float(center[2])), 0
    with ThreadPoolExecutor(2) as executor:  # neither needs the tree, and kernels and NumPy release the GIL
        neighbours = executor.submit(find_neighbours, corners)
        normals = executor.submit(compute_vertex_normals, arranged, corners)
        while node < len(tree.first):
            node = build.enclose(arranged, corners, tree, node, middle, size)
        across, upward = neighbours.result(), normals.result()
    closed = bool((across >= 0).all())
    return Tree(tree.lanes, tree.first, arranged, corners, across, upward, center, size, closed)


def make_branches(triangles: int) -> build.Branches:
    """Return the nodes of a tree over that many triangles, without boxes.

    The parts of a node are consecutive, and as few as possible, so that the nodes below are full.
    """
    low, high = np.zeros(1, np.int64), np.full(1, triangles, np.int64)
    levels = []
    while len(low):
        size, part = high - low, np.full(len(low), LANES)
        while (part * LANES < size).any():
            part = np.where(part * LANES < size, part * LANES, part)
        parts = np.where(size > LANES, (size + part - 1) // part, 0)
        levels.append((low, high, parts))
        index = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
        low, size, count = (np.repeat(values, parts) for values in (low, size, parts))
        low, high = low + size * index // count, low + size * (index + 1) // count
    low, high, parts = (np.concatenate(columns) for columns in zip(*levels, strict=True))
    first = np.where(parts == 0, ~low, np.cumsum(parts) - parts + 1).astype(np.int32)
    return build.Branches(low, high, parts, np.empty(len(low) * NODE, np.float32), first)


def arrange_vertices(vertices: Doubles, triangles: Whole) -> tuple[Doubles, Whole]:
    """Return the used vertices in the order of their first triangle, and the triangles with their new indices."""
    flat = np.ascontiguousarray(triangles, np.int32).ravel()
    first = np.full(len(vertices), len(flat), np.int32)
    first[flat[::-1]] = np.arange(len(flat) - 1, -1, -1, dtype=np.int32)  # the last assignment remains
    order = np.argsort(first)[: np.count_nonzero(first < len(flat))]
    place = np.empty(len(vertices), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    return vertices[order], place[flat].reshape(-1, 3)


def find_neighbours(triangles: Whole) -> Whole:
    """Return the triangle across each edge (m, 3).

    It is -1 for a loose edge: with no other triangle, with several, or with one of inconsistent winding.
    """
    edges = list_edges(triangles)
    second = np.flatnonzero((edges.first != np.arange(len(edges.first))) & (edges.counts[edges.first] == 2))
    second = second[edges.forward[second] != edges.forward[edges.first[second]]]
    across = np.full(len(edges.first), -1, np.int32)
    across[second], across[edges.first[second]] = edges.first[second] // 3, second // 3
    return across.reshape(-1, 3)


def compute_vertex_normals(vertices: Doubles, triangles: Whole) -> Doubles:
    """Return the unit normals (n, 3) of the vertices, weighted by the triangles' angles there; +z if they cancel."""
    normals = np.zeros((len(vertices), 3))
    for block, corners in iter_corner_blocks(vertices, triangles):
        a, b, c = corners
        face = normalize(np.cross(b - a, c - a))
        for i in range(3):
            here, ahead, behind = (corners[(i + k) % 3] for k in range(3))
            cosines = (normalize(ahead - here) * normalize(behind - here)).sum(axis=1)
            angles = np.arccos(np.clip(cosines, -1.0, 1.0))
            for axis in range(3):  # one dimension: several times as fast
                np.add.at(normals[:, axis], triangles[block, i], angles * face[:, axis])
    normals = normalize(normals)
    normals[(normals == 0.0).all(axis=1)] = (0.0, 0.0, 1.0)
    return normals


def normalize(vectors: Doubles) -> Doubles:
    """Return vectors (n, 3) divided by their lengths; a zero vector is unchanged. No square over- or underflows."""
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    scaled: Doubles = np.divide(vectors, largest, out=np.zeros_like(vectors), where=largest > 0.0)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    np.divide(scaled, length, out=scaled, where=length > 0.0)
    return scaled
