"""The nearest of all triangles: level by level down the tree, through whatever can be nearer than the best known one.

That is known from the start: a contact asks first the triangles that it rests on, and where there are none the way
goes straight down to what seems nearest. So the order does not matter, and the nodes of a level are asked one after the
other without waiting for each other's answers. That, not the number of nodes, is what the time of a query hangs on.

Where so many triangles are about as near that this takes long, as in a hollow, the way is gone from there down the
slope to the lowest place: of what is nearer than a fingertip's radius any will do, for all of that is in its way.

A query has a budget of nodes and triangles. When it is used up the answer is a bound: nothing is nearer than that.
"""

from typing import Any, NamedTuple

import numpy as np

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import Mesh, Triangles, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.budget import ROOM
from softfinger.proxy.kernels.shapes.mesh.lanes import (
    LANES,
    NODE,
    from_there,
    room_for_bounds,
    room_for_lanes,
    room_for_nodes,
    sift,
)
from softfinger.proxy.kernels.shapes.mesh.triangle import beyond_edge, corners_of, foot_on

FAR = 1e4
"""Sizes of the mesh from its middle beyond which a point is moved there to be asked for: float32 has no more digits."""
MANY = 64
"""Nodes and triangles after which what was known is taken for far, and a way down is gone at the end of each level."""
CLIMB = 24
"""Edges that the way to a first known triangle goes over, towards what is nearer."""
SLOPE = 128
"""Edges that a way goes over which looks for the lowest place of a hollow."""
SAME = 1e-11
"""Share by which another triangle must be nearer, squared, than a known one to take its place: on an edge two are."""


class Found(NamedTuple):
    """The nearest triangle.

    number        -1 where none is within the limit; where the budget was used up, the nearest known one
    square  m^2   of its distance
    bound   m^2   nothing is nearer than the root of this: `square`, or less where the budget was used up
    spent         nodes and triangles asked
    """

    number: int
    square: float
    bound: float
    spent: int


@jit
def brought_near(mesh: Triangles, x: Vec3) -> Vec3:
    """`x` from the middle of the mesh, or where the way there comes within FAR sizes."""
    d = vec3.sub(x, mesh.center)
    largest = max(abs(d[0]), abs(d[1]), abs(d[2]))
    reach = FAR * mesh.size
    if largest > reach:
        d = (reach * (d[0] / largest), reach * (d[1] / largest), reach * (d[2] / largest))
    return d


@jit
def upward(square: float) -> np.float32:
    """A float32 that is not below."""
    return np.float32(min(square * (1.0 + 1e-6), 1e35))


@jit
def middle_of(mesh: Triangles, node: int, lane: int) -> Vec3:
    """Of the box in a lane, (3,) m from that of the mesh."""
    at = node * NODE + lane
    return (float(mesh.nodes[at]), float(mesh.nodes[at + LANES]), float(mesh.nodes[at + 2 * LANES]))


class Guess(NamedTuple):
    """A triangle that may be the nearest, -1 where the way to it led to none below a limit, the square of its distance,
    m^2, and what was asked for it."""

    number: int
    square: float
    spent: int


@jit
def way_down(whole: Mesh, node: int, near: Vec3, x: Vec3, limit: float, bounds: Any, waiting: Any, begin: int) -> Guess:
    """Straight down the tree from a node to what seems nearest, and from there over edges to what is nearer.

    near            (3,)  where x is for the tree
    limit           m^2   nothing farther is looked for
    bounds, waiting       room for `sift`, of the bounds from `begin` on
    """
    mesh, spent = whole.row[0], 0
    point = (np.float32(near[0]), np.float32(near[1]), np.float32(near[2]))
    while True:
        spent += 1
        many = sift(mesh.nodes, node, point, upward(limit), bounds, waiting, begin)
        if many == 0:
            return Guess(-1, limit, spent)
        lane, closest = 0, 1e300
        for i in range(many):
            apart = vec3.sub(near, middle_of(mesh, node, int(waiting[i]) - begin))
            if vec3.dot(apart, apart) < closest:
                lane, closest = int(waiting[i]) - begin, vec3.dot(apart, apart)
        first = int(mesh.first[node])
        if first < 0:
            break
        node = first + lane
    number = ~first + lane
    square = foot_on(corners_of(mesh, number), x).square
    for _ in range(CLIMB):
        spent += 1
        beyond = int(beyond_edge(whole, float(number), x))
        if beyond == number:
            break
        number = beyond
        square = foot_on(corners_of(mesh, number), x).square
    return Guess(number, square, spent)


@jit
def lowest_of(bounds: Any, waiting: Any, at: int, end: int) -> int:
    """The place with the smallest bound of those that wait."""
    lowest = int(waiting[at])
    for i in range(at + 1, end):
        if bounds[int(waiting[i])] < bounds[lowest]:
            lowest = int(waiting[i])
    return lowest


@jit
def down_slope(mesh: Triangles, begun: Guess, x: Vec3) -> Guess:
    """Over edges to the nearest of three neighbours, as long as one is nearer. In a hollow the foot of every triangle
    is within it, and does not tell over which edge the next one is."""
    number, square, spent = begun
    for _ in range(SLOPE if number >= 0 else 0):
        nearer = -1
        for k in range(3):
            other = int(mesh.across[3 * number + k])
            if other >= 0:
                apart = foot_on(corners_of(mesh, other), x).square
                spent += 1
                if apart < square:
                    nearer, square = other, apart
        if nearer < 0:
            break
        number = nearer
    return Guess(number, square, spent)


@jit
def first_guess(
    whole: Mesh, near: Vec3, x: Vec3, limit: float, known: Vec3, bounds: Any, waiting: Any
) -> tuple[Guess, int]:
    """The nearest of the `known` triangles, or where none is known, of `way_down`; of no triangle where none is nearer
    than `limit`. And the triangle at which it ended, -1 for none."""
    mesh, number, square, spent, last = whole.row[0], -1, limit * limit, 0, -1
    for k in known:
        if 0.0 <= k < mesh.number:  # of several meshes each is told of the others' too
            last = int(k)
            foot = foot_on(corners_of(mesh, last), x)
            spent += 1
            if foot.square < square:
                number, square = last, foot.square
    if last < 0:
        last, apart, spent = way_down(whole, 0, near, x, square, bounds, waiting, 0)
        if apart < square:
            number, square = last, apart
    return Guess(number, square, spent), last


@outlined
def nearest(whole: Mesh, x: Vec3, limit: float, known: Vec3, budget: int, enough: float) -> Found:
    """The triangle nearest to `x` (3,) m among those nearer than `limit` (m).

    known   (3,)  numbers of up to three triangles near x that are asked first, and kept where no other is nearer; -1
                  for none
    budget        nodes and triangles, ROOM at most
    enough  m     where many triangles are about as near, one that is nearer than this will do; 0 for the nearest of all
    """
    mesh = whole.row[0]
    near = brought_near(mesh, x)
    point = (np.float32(near[0]), np.float32(near[1]), np.float32(near[2]))
    bounds, waiting, firsts = room_for_bounds(), room_for_lanes(), room_for_nodes()
    most = min(budget, ROOM)
    (number, square, spent), guess = first_guess(whole, near, x, limit, known, bounds, waiting)
    if guess < 0 and spent == 1:
        return Found(-1, square, square, spent)
    best = square if number < 0 else square * (1.0 - SAME)
    top = upward(best)
    firsts[0] = mesh.first[0]
    end = sift(mesh.nodes, 0, point, top, bounds, waiting, 0)
    nodes, at, level = 1, 0, 0
    while at < end:
        if at == level:
            level = end
            if spent + end >= MANY and spent + end < most:
                place = lowest_of(bounds, waiting, at, end)
                first, lane = int(firsts[place // LANES]), place % LANES
                down = Guess(~first + lane, square, 0)
                if first >= 0:
                    there, begin = from_there(waiting, end), nodes * LANES
                    down = way_down(whole, first + lane, near, x, best, bounds, there, begin)
                if down.number < 0:
                    down = Guess(number if number >= 0 else guess, best, down.spent)
                down = down_slope(mesh, down, x)
                spent += down.spent
                if down.square < best:
                    number, square, best = down.number, down.square, down.square
                    top = upward(best)
                if square < enough * enough:
                    return Found(number, square, square, spent + end)
        place = int(waiting[at])
        if bounds[place] < top:
            first, lane = int(firsts[place // LANES]), place % LANES
            if first < 0:
                foot = foot_on(corners_of(mesh, ~first + lane), x)
                if foot.square < best:
                    number, square, best = ~first + lane, foot.square, foot.square
                    top = upward(best)
            elif spent + end >= most:
                lowest = min(square, float(bounds[lowest_of(bounds, waiting, at, end)]))
                if guess < 0:
                    guess, _, _ = way_down(whole, 0, near, x, 1e300, bounds, waiting, 0)
                return Found(guess if number < 0 else number, square, lowest, spent + end)
            else:
                firsts[nodes] = mesh.first[first + lane]
                begin = nodes * LANES
                end += sift(mesh.nodes, first + lane, point, top, bounds, from_there(waiting, end), begin)
                nodes += 1
        at += 1
    return Found(number, square, square, spent + end)
