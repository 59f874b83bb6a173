"""The tree over a mesh's triangles: eight equal parts, and eight of each, cut where they are longest.

Compiled, on arrays that the caller has made: `proxy/meshes` has them.
"""

from math import acos
from typing import Any, NamedTuple

import numpy as np

from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.mesh.lanes import FIELDS, LANES, NODE
from softfinger.proxy.kernels.shapes.protocol import Z_AXIS, any_tangent, direction

ROUNDED_PLACE, ROUNDED_AXES = 2.5e-7, 2e-6
"""Shares of the mesh's size, and of a box's own, by which boxes are larger than what they hold: float32 has 6e-8 of a
coordinate, and the axes that go along with it are as far from square to each other."""
SAMPLES = 32
"""Triangles of a box that are looked at for which way its sides should go."""
NOTHING = -1e18
"""Half of a box that holds nothing: it is farther than anything."""


@jit
def parts(count: int) -> int:
    """Into how many parts a node with so many triangles is cut: as few as make all nodes below full."""
    part = LANES
    while part * LANES < count:
        part *= LANES
    return (count + part - 1) // part


@entry
def count_nodes(triangles: int, low: Any, high: Any) -> int:
    """Nodes of a tree over so many triangles, and which triangles (int64 arrays, long enough) are in each.

    A node's parts follow one another, and come behind all nodes of its level that come before it.
    """
    low[0], high[0] = 0, triangles
    count, node = 1, 0
    while node < count:
        size = high[node] - low[node]
        if size > LANES:
            k = parts(size)
            for i in range(k):
                low[count + i] = low[node] + size * i // k
                high[count + i] = low[node] + size * (i + 1) // k
            count += k
        node += 1
    return count


@entry
def take_middles(vertices: Any, corners: Any, center: Vec3, middles: Any) -> None:
    """Middles of the triangles, three times over, from `center`: (triangles, 3) float32, filled."""
    for k in range(len(corners)):
        for axis in range(3):
            total = vertices[corners[k, 0], axis] + vertices[corners[k, 1], axis] + vertices[corners[k, 2], axis]
            middles[k, axis] = total - 3.0 * center[axis]


@jit
def swap(middles: Any, order: Any, i: int, j: int) -> None:
    order[i], order[j] = order[j], order[i]
    for axis in range(3):
        middles[i, axis], middles[j, axis] = middles[j, axis], middles[i, axis]


@jit
def longest(middles: Any, low: int, high: int) -> int:
    """The axis along which the middles of some triangles are farthest apart."""
    axis, widest = 0, np.float32(-1.0)
    for k in range(3):
        least, most = middles[low, k], middles[low, k]
        for i in range(low + 1, high):
            least, most = min(least, middles[i, k]), max(most, middles[i, k])
        if most - least > widest:
            axis, widest = k, most - least
    return axis


@jit
def cut(middles: Any, order: Any, low: int, high: int, at: int) -> None:
    """Bring those that are first along the longest axis below `at`, the others from there on (Hoare's selection).

    Equal ones are shared out, so that a mesh folded into one point takes no longer.
    """
    axis = longest(middles, low, high)
    left, right = low, high - 1
    while left < right:
        one, two, three = middles[left, axis], middles[(left + right) // 2, axis], middles[right, axis]
        pivot = max(min(one, two), min(max(one, two), three))
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
def arrange(middles: Any, order: Any, low: Any, high: Any, nodes: int, first_node: int) -> int:
    """Sort triangles into the tree, as many nodes as a part of a second takes; returns the next node, of all `nodes`.

    middles  (triangles, 3)  float32, moved along with
    order    (triangles,)    int32   which triangle is where
    """
    work, node = 0, first_node
    while node < nodes and work < 4_000_000:
        begin, size = low[node], high[node] - low[node]
        if size > LANES:
            k = parts(size)
            step = k
            # Halves, their halves and theirs: each cut is where parts meet.
            while step > 1:
                half = (step + 1) // 2
                i = 0
                while i + half < k:
                    there, at = begin + size * min(i + step, k) // k, begin + size * (i + half) // k
                    cut(middles, order, begin + size * i // k, there, at)
                    i += step
                step = half
            work += 3 * size
        node += 1
    return node


@jit
def corner(vertices: Any, corners: Any, triangle: int, i: int) -> Vec3:
    at = corners[triangle, i]
    return (vertices[at, 0], vertices[at, 1], vertices[at, 2])


@jit
def area_normal(vertices: Any, corners: Any, triangle: int) -> Vec3:
    """Normal (3,) of the triangle, twice its area long."""
    a = corner(vertices, corners, triangle, 0)
    return vec3.cross(
        vec3.sub(corner(vertices, corners, triangle, 1), a), vec3.sub(corner(vertices, corners, triangle, 2), a)
    )


class Box(NamedTuple):
    """A box in a frame of its own: its middle (3,) m, unit axes (3,) along its sides, halves of them (3,) m."""

    middle: Vec3
    one: Vec3
    two: Vec3
    up: Vec3
    half: Vec3


@jit
def box_along(vertices: Any, corners: Any, some: tuple[int, int, int], up: Vec3, side: Vec3) -> Box:
    """The box round some triangles whose sides go along `up` and, square to it, along `side` as far as that can be.

    some   from the first to before the last, by steps
    """
    size, one = direction(vec3.reject(side, up), Z_AXIS)
    if size <= 1e-6 * vec3.norm(side):
        one = any_tangent(up)
    two = vec3.cross(up, one)
    least, most = (1e300, 1e300, 1e300), (-1e300, -1e300, -1e300)
    for k in range(some[0], some[1], some[2]):
        for i in range(3):
            x = corner(vertices, corners, k, i)
            y = (vec3.dot(x, one), vec3.dot(x, two), vec3.dot(x, up))
            least = (min(least[0], y[0]), min(least[1], y[1]), min(least[2], y[2]))
            most = (max(most[0], y[0]), max(most[1], y[1]), max(most[2], y[2]))
    mid, half = vec3.scale(0.5, vec3.add(least, most)), vec3.scale(0.5, vec3.sub(most, least))
    middle = vec3.add(vec3.add(vec3.scale(mid[0], one), vec3.scale(mid[1], two)), vec3.scale(mid[2], up))
    return Box(middle, one, two, up, half)


@jit
def longest_side(vertices: Any, corners: Any, some: tuple[int, int, int]) -> Vec3:
    """The longest side (3,) m of some triangles."""
    side, square = (0.0, 0.0, 0.0), 0.0
    for k in range(some[0], some[1], some[2]):
        for i in range(3):
            edge = vec3.sub(corner(vertices, corners, k, (i + 1) % 3), corner(vertices, corners, k, i))
            if vec3.dot(edge, edge) > square:
                side, square = edge, vec3.dot(edge, edge)
    return side


@jit
def put_box(lanes: Any, at: int, vertices: Any, corners: Any, low: int, high: int, center: Vec3, size: float) -> None:
    """The box round some triangles into a lane, `at` its first number; thin along their mean normal.

    Of a patch it has the sides along which the tree was cut, which are those of space; of one triangle, or many that
    lie side by side and are thin, the longest one's.
    """
    total = (0.0, 0.0, 0.0)
    for k in range(low, high):
        total = vec3.add(total, area_normal(vertices, corners, k))
    _, up = direction(total, Z_AXIS)
    some = (low, high, 1 + (high - low) // SAMPLES)
    side = longest_side(vertices, corners, some)
    if high - low > 1:
        box = box_along(vertices, corners, some, up, side)
        for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
            other = box_along(vertices, corners, some, up, axis)
            if other.half[0] * other.half[1] < box.half[0] * box.half[1]:
                side, box = axis, other
    box = box_along(vertices, corners, (low, high, 1), up, side)
    widest = max(box.half[0], box.half[1], box.half[2])
    for i in range(3):
        lanes[at + LANES * i] = box.middle[i] - center[i]
        lanes[at + LANES * (3 + i)] = box.up[i]
        lanes[at + LANES * (6 + i)] = box.one[i]
        lanes[at + LANES * (9 + i)] = box.half[i] + ROUNDED_PLACE * size + ROUNDED_AXES * widest


class Branches(NamedTuple):
    """The nodes of a tree: which triangles are in each, (nodes,) int64; lanes and children as `Triangles` has them."""

    low: Any
    high: Any
    lanes: Any
    first: Any


@entry
def enclose(
    vertices: Any, corners: Any, tree: Branches, first_node: int, child: int, center: Vec3, size: float
) -> tuple[int, int]:
    """Boxes of some nodes' lanes, and where their children are; returns the next node and the next child."""
    low, high, lanes, first = tree
    work, node = 0, first_node
    while node < len(first) and work < 2_000_000:
        count = high[node] - low[node]
        k = count if count <= LANES else parts(count)
        leaf = count <= LANES
        first[node] = ~low[node] if leaf else child
        for i in range(LANES):
            at = node * NODE + i
            if i >= k:
                for field in range(FIELDS):
                    lanes[at + LANES * field] = 0.0
                lanes[at + LANES * 9] = NOTHING
            elif leaf:
                put_box(lanes, at, vertices, corners, low[node] + i, low[node] + i + 1, center, size)
            else:
                put_box(lanes, at, vertices, corners, low[child + i], high[child + i], center, size)
        if not leaf:
            child += k
        work += count
        node += 1
    return node, child


@entry
def renumber(corners: Any, order: Any, arranged: Any, place: Any) -> int:
    """Triangles in their order in the tree, vertices in that of their first triangle; returns how many are used.

    arranged  (triangles, 3)  int32, filled
    place     (vertices,)     int32, -1 each; filled with where each vertex goes
    """
    used = 0
    for k in range(len(order)):
        for i in range(3):
            vertex = corners[order[k], i]
            if place[vertex] < 0:
                place[vertex] = used
                used += 1
            arranged[k, i] = place[vertex]
    return used


@entry
def join(corners: Any, begin: Any, around: Any, across: Any) -> int:
    """What is beyond each edge; returns how many edges have no other triangle, or more than one, or one the other way.

    begin   (vertices + 1,)    int32, 0 each    where in `around` the edges from a vertex begin
    around  (triangles * 3,)   int32            edges, 3 triangle + i, by the lower of their vertices
    across  (triangles, 3)     int32            filled: the other triangle, -1 for none or for several
    """
    count = len(corners)
    for k in range(count):
        for i in range(3):
            begin[min(corners[k, i], corners[k, (i + 1) % 3]) + 1] += 1
            across[k, i] = -1
    for v in range(1, len(begin)):
        begin[v] += begin[v - 1]
    for k in range(count):  # each fills its place from the end of the one before, which moves it up
        for i in range(3):
            v = min(corners[k, i], corners[k, (i + 1) % 3])
            around[begin[v]] = 3 * k + i
            begin[v] += 1
    loose, start = 0, 0
    for v in range(len(begin) - 1):
        end = begin[v]
        for one in range(start, end):
            k, i = around[one] // 3, around[one] % 3
            there = max(corners[k, i], corners[k, (i + 1) % 3])
            met, against = 0, False
            for other in range(start, end):
                m, j = around[other] // 3, around[other] % 3
                if other != one and max(corners[m, j], corners[m, (j + 1) % 3]) == there:
                    met += 1
                    against = corners[m, j] != corners[k, i]
                    across[k, i] = m
            if met != 1 or not against:
                loose += 1
                across[k, i] = -1
        start = end
    return loose


@jit
def angle_at(a: Vec3, b: Vec3, c: Vec3) -> float:
    """Angle (rad) of a triangle at `a`."""
    _, one = direction(vec3.sub(b, a), Z_AXIS)
    _, two = direction(vec3.sub(c, a), Z_AXIS)
    return acos(max(-1.0, min(1.0, vec3.dot(one, two))))


@entry
def raise_normals(vertices: Any, corners: Any, upward: Any) -> None:
    """Normals at the vertices, (vertices, 3), 0 each, filled: unit, each triangle counting as its angle there does."""
    for k in range(len(corners)):
        _, normal = direction(area_normal(vertices, corners, k), (0.0, 0.0, 0.0))
        for i in range(3):
            angle = angle_at(
                corner(vertices, corners, k, i),
                corner(vertices, corners, k, (i + 1) % 3),
                corner(vertices, corners, k, (i + 2) % 3),
            )
            at = corners[k, i]
            for axis in range(3):
                upward[at, axis] += angle * normal[axis]
    for v in range(len(upward)):
        _, normal = direction((upward[v, 0], upward[v, 1], upward[v, 2]), Z_AXIS)
        for axis in range(3):
            upward[v, axis] = normal[axis]
