"""Tree over the triangles of a mesh, built by kernels, in the form that the kernels of a tick take."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.shapes.mesh import build
from softfinger.proxy.kernels.shapes.mesh.lanes import NODE

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
    count = len(triangles)
    middles = np.empty((count, 3), np.float32)
    columns = [vertices[:, axis] for axis in range(3)]  # column by column: five times as fast
    least, most = np.array([x.min() for x in columns]), np.array([x.max() for x in columns])
    center = 0.5 * (least + most)
    middle = (float(center[0]), float(center[1]), float(center[2]))
    triangles = np.ascontiguousarray(triangles, np.int32)
    build.take_middles(vertices, triangles, middle, middles)
    room = count // 2 + 64  # at worst, nine triangles make two leaves under one node
    low, high = np.empty(room, np.int64), np.empty(room, np.int64)
    nodes = build.count_nodes(count, low, high)
    order = np.arange(count, dtype=np.int32)
    node = 0
    while node < nodes:
        node = build.arrange(middles, order, low, high, nodes, node)
    corners, place = np.empty((count, 3), np.int32), np.full(len(vertices), -1, np.int32)
    used = build.renumber(triangles, order, corners, place)
    arranged = np.empty((used, 3))
    is_used = place >= 0
    arranged[place[is_used]] = vertices[is_used]
    size = float(np.sqrt(((most - least) ** 2).sum()))
    lanes, first = np.empty(nodes * NODE, np.float32), np.empty(nodes, np.int32)
    tree, node, child = build.Branches(low, high, lanes, first), 0, 1
    across, upward = np.empty((count, 3), np.int32), np.zeros((used, 3))
    with ThreadPoolExecutor(2) as threads:  # neither needs the tree, and kernels release the GIL
        rooms = np.zeros(used + 1, np.int32), np.empty(3 * count, np.int32)
        loose = threads.submit(build.join, corners, *rooms, across)
        normals = threads.submit(build.raise_normals, arranged, corners, upward)
        while node < nodes:
            node, child = build.enclose(arranged, corners, tree, node, child, middle, size)
        normals.result()
    return Tree(lanes, first, arranged, corners, across, upward, center, size, loose.result() == 0)
