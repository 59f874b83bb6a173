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

    number        of the triangle, -1 if none is within the limit; the nearest known one if the budget was exhausted
    square  m^2   squared distance
    bound   m^2   lower bound of the squared distance: `square`, or less if the budget was exhausted
    spent         nodes and triangles visited
    """

    number: int
    square: float
    bound: float
    spent: int


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
    at = node * NODE + lane
    return (float(mesh.nodes[at]), float(mesh.nodes[at + LANES]), float(mesh.nodes[at + 2 * LANES]))


class Candidate(NamedTuple):
    """Candidate for the nearest triangle.

    number        of the triangle, -1 if none was found below a limit
    square  m^2   squared distance
    spent         nodes and triangles visited
    """

    number: int
    square: float
    spent: int


@jit
def descend_tree(
    whole: Mesh, node: int, near: Vec3, x: Vec3, limit: float, bounds: Any, waiting: Any, begin: int
) -> Candidate:
    """Descend greedily from a node of the tree to a triangle, and from there over edges to closer ones.

    near            (3,)  m    x in the frame of the tree (`to_search_frame`)
    limit                 m^2  boxes farther away are ignored
    bounds, waiting            scratch for `sift`; of `bounds` from `begin`
    """
    mesh, spent = whole.row[0], 0
    point = (np.float32(near[0]), np.float32(near[1]), np.float32(near[2]))
    while True:
        spent += 1
        many = sift(mesh.nodes, node, point, round_up(limit), bounds, waiting, begin)
        if many == 0:
            return Candidate(-1, limit, spent)
        lane, closest = 0, 1e300
        for i in range(many):
            apart = vec3.sub(near, find_middle(mesh, node, int(waiting[i]) - begin))
            if vec3.dot(apart, apart) < closest:
                lane, closest = int(waiting[i]) - begin, vec3.dot(apart, apart)
        first = int(mesh.first[node])
        if first < 0:
            break
        node = first + lane
    number = ~first + lane
    square = find_foot_on(read_corners(mesh, number), x).square
    for _ in range(MAX_CLIMB_EDGES):
        spent += 1
        beyond = int(nearer_neighbour(whole, float(number), x))
        if beyond == number:
            break
        number = beyond
        square = find_foot_on(read_corners(mesh, number), x).square
    return Candidate(number, square, spent)


@jit
def find_lowest(bounds: Any, waiting: Any, at: int, end: int) -> int:
    """Return the index of the smallest bound in the queue."""
    lowest = int(waiting[at])
    for i in range(at + 1, end):
        if bounds[int(waiting[i])] < bounds[lowest]:
            lowest = int(waiting[i])
    return lowest


@jit
def walk_downhill(mesh: Triangles, begun: Candidate, x: Vec3) -> Candidate:
    """Move to the closest of the three neighbours as long as one is closer.

    In a hollow the nearest point of a triangle is in its interior, and does not show which edge to cross.
    """
    number, square, spent = begun
    for _ in range(MAX_HOLLOW_EDGES if number >= 0 else 0):
        nearer = -1
        for k in range(3):
            neighbour = int(mesh.across[3 * number + k])
            if neighbour >= 0:
                apart = find_foot_on(read_corners(mesh, neighbour), x).square
                spent += 1
                if apart < square:
                    nearer, square = neighbour, apart
        if nearer < 0:
            break
        number = nearer
    return Candidate(number, square, spent)


@jit
def find_first_candidate(
    whole: Mesh, near: Vec3, x: Vec3, limit: float, known: Vec3, bounds: Any, waiting: Any
) -> tuple[Candidate, int]:
    """Return the closest of the `known` triangles within `limit` (m), and the last triangle tested, -1 for none.

    Without known triangles, both are the result of `descend_tree`.
    """
    mesh, number, square, spent, last = whole.row[0], -1, limit * limit, 0, -1
    for k in known:
        if 0.0 <= k < mesh.number:  # `known` may contain triangles of other meshes
            last = int(k)
            foot = find_foot_on(read_corners(mesh, last), x)
            spent += 1
            if foot.square < square:
                number, square = last, foot.square
    if last < 0:
        last, apart, spent = descend_tree(whole, 0, near, x, square, bounds, waiting, 0)
        if apart < square:
            number, square = last, apart
    return Candidate(number, square, spent), last


@outlined
def find_nearest(whole: Mesh, x: Vec3, limit: float, known: Vec3, budget: int, enough: float) -> NearestTriangle:
    """Return the triangle nearest to `x` (3,) m within `limit` (m).

    known   (3,)  numbers of up to three triangles near x, -1 for none: tested first, and preferred to equally near ones
    budget        nodes and triangles to visit, at most ROOM
    enough  m     distance below which a triangle is accepted if the search takes long; 0 for the exact nearest
    """
    mesh = whole.row[0]
    near = to_search_frame(mesh, x)
    if isnan(near[0] + near[1] + near[2]):  # all boxes would count as near, also the empty ones
        return NearestTriangle(-1, limit * limit, limit * limit, 0)
    point = (np.float32(near[0]), np.float32(near[1]), np.float32(near[2]))
    bounds, waiting, firsts = room_for_bounds(), room_for_lanes(), room_for_nodes()
    most = min(budget, QUEUE_SIZE)
    (number, square, spent), guess = find_first_candidate(whole, near, x, limit, known, bounds, waiting)
    if guess < 0 and spent == 1:
        return NearestTriangle(-1, square, square, spent)
    best = square if number < 0 else square * (1.0 - REPLACE_SHARE)
    top = round_up(best)
    firsts[0] = mesh.first[0]
    end = sift(mesh.nodes, 0, point, top, bounds, waiting, 0)
    nodes, at, level = 1, 0, 0
    while at < end:
        if at == level:
            level = end
            if spent + end >= POOR_CANDIDATE_VISITS and spent + end < most:
                place = find_lowest(bounds, waiting, at, end)
                first, lane = int(firsts[place // LANES]), place % LANES
                down = Candidate(~first + lane, square, 0)
                if first >= 0:
                    free, begin = slice_from(waiting, end), nodes * LANES
                    down = descend_tree(whole, first + lane, near, x, best, bounds, free, begin)
                if down.number < 0 and number >= 0:
                    down = Candidate(number, best, down.spent)
                elif down.number < 0 and guess >= 0:  # the walk may begin beyond the limit
                    down = Candidate(guess, find_foot_on(read_corners(mesh, guess), x).square, down.spent + 1)
                down = walk_downhill(mesh, down, x)
                spent += down.spent
                if down.square < best:
                    number, square, best = down.number, down.square, down.square
                    top = round_up(best)
                if square < enough * enough:
                    return NearestTriangle(number, square, square, spent + end)
        place = int(waiting[at])
        if bounds[place] < top:
            first, lane = int(firsts[place // LANES]), place % LANES
            if first < 0:
                foot = find_foot_on(read_corners(mesh, ~first + lane), x)
                if foot.square < best:
                    number, square, best = ~first + lane, foot.square, foot.square
                    top = round_up(best)
            elif spent + end >= most:
                lowest = min(square, float(bounds[find_lowest(bounds, waiting, at, end)]))
                if guess < 0:
                    guess, _, _ = descend_tree(whole, 0, near, x, 1e300, bounds, waiting, 0)
                return NearestTriangle(guess if number < 0 else number, square, lowest, spent + end)
            else:
                firsts[nodes] = mesh.first[first + lane]
                begin = nodes * LANES
                end += sift(mesh.nodes, first + lane, point, top, bounds, slice_from(waiting, end), begin)
                nodes += 1
        at += 1
    return NearestTriangle(number, square, square, spent + end)
