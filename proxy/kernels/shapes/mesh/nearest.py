"""Nearest triangle of a mesh: breadth-first search of the tree, through all boxes closer than the best known triangle.

A good candidate is known from the start: a triangle of the present contact, or else the result of a greedy descent. So
the order of the nodes is not important, and the nodes of a level are tested without waiting for each other's results.
These waits, not the number of nodes, determine the time of a query.

If the search takes long because many triangles are about equally near, as in a hollow, it descends greedily after each
level, and from there over neighbouring triangles to a local minimum of the distance. A contact accepts any triangle
closer than the fingertip's radius, because each of them obstructs the fingertip.

A query has a budget of nodes and triangles. If it is exhausted, the result includes a lower bound of the distance.
"""

from math import isnan
from typing import Any, NamedTuple

import numpy as np

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import Mesh, Triangles, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.budget import QUEUE_SIZE
from softfinger.proxy.kernels.shapes.mesh.lanes import (
    LANES,
    NODE,
    room_for_bounds,
    room_for_lanes,
    room_for_nodes,
    sift,
    slice_from,
)
from softfinger.proxy.kernels.shapes.mesh.triangle import find_foot_on, nearer_neighbour, read_corners

MAX_DISTANCE_SIZES = 1e4
"""Largest distance of a searched point from the middle of the mesh, in sizes of the mesh. Farther points are moved
there before the search, because float32 has no more digits."""
POOR_CANDIDATE_VISITS = 64
"""Nodes and triangles after which the known candidate counts as poor: a greedy descent then follows each level."""
MAX_CLIMB_EDGES = 24
"""Limit of the edges crossed towards closer triangles after a greedy descent."""
MAX_HOLLOW_EDGES = 128
"""Limit of the edges crossed in the search of a local minimum in a hollow."""
REPLACE_SHARE = 1e-11
"""Share by which the squared distance of another triangle must be smaller to replace a known one: on an edge, two are
equally near."""


class NearestTriangle(NamedTuple):
    """Nearest triangle.

    triangle               index, -1 if none is within the limit; the nearest known one if the budget was exhausted
    squared_distance  m^2
    bound             m^2  lower bound of `squared_distance`: equal to it, or less if the budget was exhausted
    visits                 number of nodes and triangles visited
    """

    triangle: int
    squared_distance: float
    bound: float
    visits: int


@jit
def to_search_frame(mesh: Triangles, x: Vec3) -> Vec3:
    """Return `x` relative to the middle of the mesh, moved towards it to at most MAX_DISTANCE_SIZES along each axis."""
    d = vec3.sub(x, mesh.center)
    largest = max(abs(d[0]), abs(d[1]), abs(d[2]))
    reach = MAX_DISTANCE_SIZES * mesh.size
    if largest > reach:
        d = (reach * (d[0] / largest), reach * (d[1] / largest), reach * (d[2] / largest))
    return d


@jit
def round_up(square: float) -> np.float32:
    """Convert to float32, rounded up; at most 1e35."""
    return np.float32(min(square * (1.0 + 1e-6), 1e35))


@jit
def find_middle(mesh: Triangles, node: int, lane: int) -> Vec3:
    """Return the middle of the box in a lane, (3,) m, relative to the middle of the mesh."""
    first = node * NODE + lane
    return (float(mesh.nodes[first]), float(mesh.nodes[first + LANES]), float(mesh.nodes[first + 2 * LANES]))


class Candidate(NamedTuple):
    """Candidate for the nearest triangle.

    triangle               index, -1 if none was found below a limit
    squared_distance  m^2
    visits                 number of nodes and triangles visited
    """

    triangle: int
    squared_distance: float
    visits: int


@jit
def descend_tree(
    shape: Mesh, node: int, near: Vec3, x: Vec3, limit: float, bounds: Any, waiting: Any, begin: int
) -> Candidate:
    """Descend greedily from a node of the tree to a triangle, and from there over edges to closer ones.

    near            (3,)  m    x in the frame of the tree (`to_search_frame`)
    limit                 m^2  boxes farther away are ignored
    bounds, waiting            scratch for `sift`; of `bounds` from `begin`
    """
    mesh, visits = shape.row[0], 0
    point = (np.float32(near[0]), np.float32(near[1]), np.float32(near[2]))
    while True:
        visits += 1
        many = sift(mesh.nodes, node, point, round_up(limit), bounds, waiting, begin)
        if many == 0:
            return Candidate(-1, limit, visits)
        lane, closest = 0, 1e300
        for i in range(many):
            apart = vec3.sub(near, find_middle(mesh, node, int(waiting[i]) - begin))
            if vec3.dot(apart, apart) < closest:
                lane, closest = int(waiting[i]) - begin, vec3.dot(apart, apart)
        first = int(mesh.first[node])
        if first < 0:
            break
        node = first + lane
    triangle = ~first + lane
    square = find_foot_on(read_corners(mesh, triangle), x).squared_distance
    for _ in range(MAX_CLIMB_EDGES):
        visits += 1
        beyond = int(nearer_neighbour(shape, float(triangle), x))
        if beyond == triangle:
            break
        triangle = beyond
        square = find_foot_on(read_corners(mesh, triangle), x).squared_distance
    return Candidate(triangle, square, visits)


@jit
def find_lowest(bounds: Any, waiting: Any, at: int, end: int) -> int:
    """Return the index of the smallest bound in the queue."""
    lowest = int(waiting[at])
    for i in range(at + 1, end):
        if bounds[int(waiting[i])] < bounds[lowest]:
            lowest = int(waiting[i])
    return lowest


@jit
def choose_start(mesh: Triangles, x: Vec3, found: Candidate, known: Candidate, guess: int) -> Candidate:
    """Return the start of a walk: `found`, else `known`, else the triangle `guess`, which may be beyond the limit."""
    if found.triangle >= 0:
        return found
    if known.triangle >= 0:
        return Candidate(known.triangle, known.squared_distance, found.visits)
    if guess < 0:
        return found
    foot = find_foot_on(read_corners(mesh, guess), x)
    return Candidate(guess, foot.squared_distance, found.visits + 1)


@jit
def walk_downhill(mesh: Triangles, begun: Candidate, x: Vec3) -> Candidate:
    """Move to the closest of the three neighbours as long as one is closer.

    In a hollow the nearest point of a triangle is in its interior, and does not show which edge to cross.
    """
    triangle, square, visits = begun
    for _ in range(MAX_HOLLOW_EDGES if triangle >= 0 else 0):
        nearer = -1
        for k in range(3):
            neighbour = int(mesh.across[3 * triangle + k])
            if neighbour >= 0:
                apart = find_foot_on(read_corners(mesh, neighbour), x).squared_distance
                visits += 1
                if apart < square:
                    nearer, square = neighbour, apart
        if nearer < 0:
            break
        triangle = nearer
    return Candidate(triangle, square, visits)


@jit
def find_first_candidate(
    shape: Mesh, near: Vec3, x: Vec3, limit: float, known: Vec3, bounds: Any, waiting: Any
) -> tuple[Candidate, int]:
    """Return the closest of the `known` triangles within `limit` (m), and the last triangle tested, -1 for none.

    Without known triangles, both are the result of `descend_tree`.
    """
    mesh, triangle, square, visits, last = shape.row[0], -1, limit * limit, 0, -1
    for k in known:
        if 0.0 <= k < mesh.triangle_count:  # `known` may contain triangles of other meshes
            last = int(k)
            foot = find_foot_on(read_corners(mesh, last), x)
            visits += 1
            if foot.squared_distance < square:
                triangle, square = last, foot.squared_distance
    if last < 0:
        last, apart, visits = descend_tree(shape, 0, near, x, square, bounds, waiting, 0)
        if apart < square:
            triangle, square = last, apart
    return Candidate(triangle, square, visits), last


@outlined
def find_nearest(shape: Mesh, x: Vec3, limit: float, known: Vec3, budget: int, enough: float) -> NearestTriangle:
    """Return the triangle nearest to `x` (3,) m within `limit` (m).

    known   (3,)  indices of up to three triangles near x, -1 for none: tested first, and preferred to equally near ones
    budget        nodes and triangles to visit, at most QUEUE_SIZE
    enough  m     distance below which a triangle is accepted if the search takes long; 0 for the exact nearest
    """
    mesh = shape.row[0]
    near = to_search_frame(mesh, x)
    if isnan(near[0] + near[1] + near[2]):  # all boxes would count as near, also the empty ones
        return NearestTriangle(-1, limit * limit, limit * limit, 0)
    point = (np.float32(near[0]), np.float32(near[1]), np.float32(near[2]))
    bounds, waiting, firsts = room_for_bounds(), room_for_lanes(), room_for_nodes()
    most = min(budget, QUEUE_SIZE)
    (triangle, square, visits), guess = find_first_candidate(shape, near, x, limit, known, bounds, waiting)
    if guess < 0 and visits == 1:
        return NearestTriangle(-1, square, square, visits)
    best = square if triangle < 0 else square * (1.0 - REPLACE_SHARE)
    top = round_up(best)
    firsts[0] = mesh.first[0]
    end = sift(mesh.nodes, 0, point, top, bounds, waiting, 0)
    nodes, at, level = 1, 0, 0
    while at < end:
        if at == level:
            level = end
            if visits + end >= POOR_CANDIDATE_VISITS and visits + end < most:
                place = find_lowest(bounds, waiting, at, end)
                first, lane = int(firsts[place // LANES]), place % LANES
                down = Candidate(~first + lane, square, 0)
                if first >= 0:
                    free, begin = slice_from(waiting, end), nodes * LANES
                    down = descend_tree(shape, first + lane, near, x, best, bounds, free, begin)
                start = choose_start(mesh, x, down, Candidate(triangle, best, 0), guess)
                down = walk_downhill(mesh, start, x)
                visits += down.visits
                if down.squared_distance < best:
                    triangle, square, best = down.triangle, down.squared_distance, down.squared_distance
                    top = round_up(best)
                if square < enough * enough:
                    return NearestTriangle(triangle, square, square, visits + end)
        place = int(waiting[at])
        if bounds[place] < top:
            first, lane = int(firsts[place // LANES]), place % LANES
            if first < 0:
                foot = find_foot_on(read_corners(mesh, ~first + lane), x)
                if foot.squared_distance < best:
                    triangle, square, best = ~first + lane, foot.squared_distance, foot.squared_distance
                    top = round_up(best)
            elif visits + end >= most:
                lowest = min(square, float(bounds[find_lowest(bounds, waiting, at, end)]))
                if guess < 0:
                    guess, _, _ = descend_tree(shape, 0, near, x, 1e300, bounds, waiting, 0)
                return NearestTriangle(guess if triangle < 0 else triangle, square, lowest, visits + end)
            else:
                firsts[nodes] = mesh.first[first + lane]
                begin = nodes * LANES
                end += sift(mesh.nodes, first + lane, point, top, bounds, slice_from(waiting, end), begin)
                nodes += 1
        at += 1
    return NearestTriangle(triangle, square, square, visits + end)
