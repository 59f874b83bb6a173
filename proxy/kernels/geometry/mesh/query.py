"""The nearest of all triangles: down the tree, what is nearest first, as far as anything can be nearer still.

A query has a budget of nodes and triangles. When it is used up the answer is a bound: nothing is nearer than that.
"""

from typing import NamedTuple

import numpy as np

from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.geometry.mesh.lanes import (
    lane_room,
    lowest_bit,
    room_for_bounds,
    room_for_nodes,
    within_lanes,
)
from softfinger.proxy.kernels.geometry.mesh.triangle import corners_of, foot_on
from softfinger.proxy.kernels.model import Mesh, Triangles, Vec3
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.outlined import outlined

BUDGET = 512
"""Nodes and triangles of a query: some ten microseconds, and many times what a fingertip on a scan needs."""
FAR = 1e4
"""Sizes of the mesh from its middle beyond which a point is moved there to be asked for: float32 has no more digits."""
SAME = 1e-11
"""Share by which another triangle must be nearer, squared, than a known one to take its place: on an edge two are."""


class Found(NamedTuple):
    """The nearest triangle.

    number        -1 where none is within the limit
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
    return np.float32(min(square * (1.0 + 1e-6), 1e36))


@outlined
def nearest(whole: Mesh, x: Vec3, limit: float, known: Vec3, budget: int) -> Found:
    """The triangle nearest to `x` (3,) m among those nearer than `limit` (m).

    known   (3,)  numbers of up to three triangles that are asked first and kept where no other is nearer; -1 for none
    """
    mesh = whole.row[0]
    near = brought_near(mesh, x)
    px, py, pz = np.float32(near[0]), np.float32(near[1]), np.float32(near[2])
    spent, number, square = 0, -1, limit * limit
    for k in known:
        if k >= 0.0:
            foot = foot_on(corners_of(mesh, int(k)), x)
            spent += 1
            if foot.square < square:
                number, square = int(k), foot.square
    best = square if number < 0 else square * (1.0 - SAME)
    top = upward(best)
    bounds, waiting, lane = room_for_bounds(), room_for_nodes(), lane_room()
    bounds[0], waiting[0] = np.float32(0.0), np.int32(0)
    count = 1
    while count > 0:
        count -= 1
        if not bounds[count] < top:
            continue
        if spent >= budget:
            lowest = bounds[count]
            for i in range(count):
                lowest = min(lowest, bounds[i])
            return Found(number, square, min(square, float(lowest)), spent)
        node = int(waiting[count])
        spent += 1
        bits = within_lanes(mesh.nodes, node, px, py, pz, top, lane)
        first = int(mesh.first[node])
        begun = count
        while bits != 0:
            i = lowest_bit(bits)
            bits &= bits - 1
            if first >= 0:  # the nearest on top
                at = count
                while at > begun and bounds[at - 1] < lane[i]:
                    bounds[at], waiting[at] = bounds[at - 1], waiting[at - 1]
                    at -= 1
                bounds[at], waiting[at] = lane[i], np.int32(first + i)
                count += 1
            elif lane[i] < top:
                foot = foot_on(corners_of(mesh, ~first + i), x)
                spent += 1
                if foot.square < best:
                    number, square, best = ~first + i, foot.square, foot.square
                    top = upward(best)
    return Found(number, square, square, spent)
