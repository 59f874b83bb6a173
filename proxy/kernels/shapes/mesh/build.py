"""Construction of the tree over a mesh's triangles: each node has up to eight equal parts, cut along the longest axis.

Compiled kernels on arrays that the caller allocates (`proxy/meshes/tree.py`).
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.mesh.lanes import FIELDS, LANES, NODE
from softfinger.proxy.kernels.shapes.protocol import Z_AXIS, any_tangent, compute_direction

PLACE_MARGIN, AXES_MARGIN = 2.5e-7, 2e-6
"""Margins of a box, as a share of the mesh's size and of the box's own: float32 rounds coordinates by 6e-8, and the
axes in float32 deviate from orthogonal by as much."""
MAX_SAMPLES = 32
"""Number of a box's triangles, about, that are sampled to choose the direction of its sides."""
EMPTY_HALF_SIDE = -1e18
"""Half side of an empty box: its computed distance exceeds any other."""


class Branches(NamedTuple):
    """Nodes of a tree, in breadth-first order.

    low, high  (nodes,) int64  range of triangles of each node
    parts      (nodes,) int64  number of its nodes in the next level, 0 for a leaf
    lanes, first               as `nodes` and `first` of `model.Triangles`
    """

    low: Any
    high: Any
    parts: Any
    lanes: Any
    first: Any


@jit
def swap(middles: Any, order: Any, i: int, j: int) -> None:
    order[i], order[j] = order[j], order[i]
    for axis in range(3):
        middles[i, axis], middles[j, axis] = middles[j, axis], middles[i, axis]


@jit
def find_longest(middles: Any, low: int, high: int) -> int:
    """Return the axis along which the middles of the triangles from `low` to `high` are farthest apart."""
    axis, widest = 0, -1.0
    for k in range(3):
        least, most = 1e300, -1e300
        for i in range(low, high):
            x = float(middles[i, k])
            least, most = min(least, x), max(most, x)
        if most - least > widest:
            axis, widest = k, most - least
    return axis


@jit
def cut(middles: Any, order: Any, low: int, high: int, at: int) -> None:
    """Move triangles with smaller coordinates on the longest axis before `at`, larger ones behind (Hoare's selection).

    Equal ones are distributed to both sides, so that a mesh collapsed to one point takes no longer.
    """
    axis = find_longest(middles, low, high)
    left, right = low, high - 1
    while left < right:
        a, b, c = float(middles[left, axis]), float(middles[(left + right) // 2, axis]), float(middles[right, axis])
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = left, right
        while i <= j:
            while middles[i, axis] < pivot:
                i += 1
            while middles[j, axis] > pivot:
                j -= 1
            if i <= j:
                swap(middles, order, i, j)
                i += 1
                j -= 1
        if at <= j:
            right = j
        elif at >= i:
            left = i
        else:
            return


@entry
def arrange(middles: Any, order: Any, tree: Branches, first_node: int) -> int:
    """Sort the triangles of some nodes, for a fraction of a second; return the next node to sort.

    middles  (triangles, 3)  float32  sorted, too
    order    (triangles,)    int32    triangle at each position
    """
    work, node = 0, first_node
    while node < len(tree.low) and work < 4_000_000:
        begin, size, k = tree.low[node], tree.high[node] - tree.low[node], tree.parts[node]
        if k > 0:
            step = k
            # Cut into halves, quarters and eighths, each time at a boundary between parts.
            while step > 1:
                half = (step + 1) // 2
                i = 0
                while i + half < k:
                    end, at = begin + size * min(i + step, k) // k, begin + size * (i + half) // k
                    cut(middles, order, begin + size * i // k, end, at)
                    i += step
                step = half
            work += 3 * size
        node += 1
    return node


@jit
def read_corner(vertices: Any, corners: Any, triangle: int, i: int) -> Vec3:
    vertex = corners[triangle, i]
    return (vertices[vertex, 0], vertices[vertex, 1], vertices[vertex, 2])


@jit
def compute_area_normal(vertices: Any, corners: Any, triangle: int) -> Vec3:
    """Return the normal (3,) of a triangle; its length is twice the area."""
    a = read_corner(vertices, corners, triangle, 0)
    return vec3.cross(
        vec3.sub(read_corner(vertices, corners, triangle, 1), a),
        vec3.sub(read_corner(vertices, corners, triangle, 2), a),
    )


class OrientedBox(NamedTuple):
    """Oriented box: middle (3,) m, unit axes (3,) along its sides, and half sides (3,) m."""

    middle: Vec3
    u: Vec3
    v: Vec3
    up: Vec3
    half: Vec3


@jit
def compute_box(vertices: Any, corners: Any, some: tuple[int, int, int], up: Vec3, side: Vec3) -> OrientedBox:
    """Return the box round some triangles with sides along `up` and along the projection of `side` normal to it.

    some   triangles: first, one after the last, step
    """
    size, u = compute_direction(vec3.reject(side, up), Z_AXIS)
    if size <= 1e-6 * vec3.norm(side):
        u = any_tangent(up)
    v = vec3.cross(up, u)
    least, most = (1e300, 1e300, 1e300), (-1e300, -1e300, -1e300)
    for k in range(some[0], some[1], some[2]):
        for i in range(3):
            x = read_corner(vertices, corners, k, i)
            y = (vec3.dot(x, u), vec3.dot(x, v), vec3.dot(x, up))
            least = (min(least[0], y[0]), min(least[1], y[1]), min(least[2], y[2]))
            most = (max(most[0], y[0]), max(most[1], y[1]), max(most[2], y[2]))
    mid, half = vec3.scale(0.5, vec3.add(least, most)), vec3.scale(0.5, vec3.sub(most, least))
    middle = vec3.add(vec3.add(vec3.scale(mid[0], u), vec3.scale(mid[1], v)), vec3.scale(mid[2], up))
    return OrientedBox(middle, u, v, up, half)


@jit
def find_longest_side(vertices: Any, corners: Any, some: tuple[int, int, int]) -> Vec3:
    """Return the longest edge (3,) m of some triangles."""
    side, square = (0.0, 0.0, 0.0), 0.0
    for k in range(some[0], some[1], some[2]):
        for i in range(3):
            edge = vec3.sub(read_corner(vertices, corners, k, (i + 1) % 3), read_corner(vertices, corners, k, i))
            if vec3.dot(edge, edge) > square:
                side, square = edge, vec3.dot(edge, edge)
    return side


@jit
def write_box(lanes: Any, at: int, vertices: Any, corners: Any, low: int, high: int, center: Vec3, size: float) -> None:
    """Write the box round some triangles to the lane with first number `at`; it is thin along their mean normal.

    The other sides are along the longest edge, or, for several triangles, along an axis of space if this makes the box
    smaller. It usually does for a patch, because the tree is cut along these axes, but not for thin parallel triangles.
    """
    total = (0.0, 0.0, 0.0)
    for k in range(low, high):
        total = vec3.add(total, compute_area_normal(vertices, corners, k))
    _, up = compute_direction(total, Z_AXIS)
    some = (low, high, 1 + (high - low) // MAX_SAMPLES)
    side = find_longest_side(vertices, corners, some)
    if high - low > 1:
        box = compute_box(vertices, corners, some, up, side)
        for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
            candidate = compute_box(vertices, corners, some, up, axis)
            if candidate.half[0] * candidate.half[1] < box.half[0] * box.half[1]:
                side, box = axis, candidate
    box = compute_box(vertices, corners, (low, high, 1), up, side)
    widest = max(box.half[0], box.half[1], box.half[2])
    for i in range(3):
        lanes[at + LANES * i] = box.middle[i] - center[i]
        lanes[at + LANES * (3 + i)] = box.up[i]
        lanes[at + LANES * (6 + i)] = box.u[i]
        lanes[at + LANES * (9 + i)] = box.half[i] + PLACE_MARGIN * size + AXES_MARGIN * widest


@entry
def enclose(vertices: Any, corners: Any, tree: Branches, first_node: int, center: Vec3, size: float) -> int:
    """Write the boxes of the parts of some nodes, for a fraction of a second; return the next node."""
    low, high, parts, lanes, first = tree
    work, node = 0, first_node
    while node < len(first) and work < 2_000_000:
        is_leaf, count, child = parts[node] == 0, high[node] - low[node], first[node]
        boxes = count if is_leaf else parts[node]
        for i in range(LANES):
            lane = node * NODE + i
            if i >= boxes:
                for field in range(FIELDS):
                    lanes[lane + LANES * field] = 0.0
                lanes[lane + LANES * 9] = EMPTY_HALF_SIDE
            elif is_leaf:
                write_box(lanes, lane, vertices, corners, low[node] + i, low[node] + i + 1, center, size)
            else:
                write_box(lanes, lane, vertices, corners, low[child + i], high[child + i], center, size)
        work += count
        node += 1
    return node
