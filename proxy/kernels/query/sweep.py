"""Which object a fingertip meets first on its way: nothing thin is jumped over in a tick, whoever moves.

The way is the one that the object sees: straight, in its own frame, from where the fingertip was to where it is.
"""

from typing import Any

from numba import literal_unroll

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.query.elements import count, element
from softfinger.proxy.kernels.query.motion import carried_along
from softfinger.proxy.kernels.shapes import NO_HIT
from softfinger.proxy.kernels.shapes.protocol import meets


@by_type
def first_in(entry: Any, at: float, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int) -> Any:
    """What of an entry that begins with the place `at` is met first: see `first_hit`.

    returns  the share of the way at which it is met, its place, where (3,) m its way begins, what is left of the budget
    """


@first_in.otherwise
def meets_it(
    entry: Any, at: float, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int
) -> tuple[float, float, Vec3, int]:
    met, number, begin = NO_HIT, 0.0, start
    if at != skip[0] and at != skip[1] and at != skip[2]:
        begin = carried_along(entry.was, entry.pose, start)
        met, number, budget = meets(entry.shape, into(entry.pose, begin), into(entry.pose, end), radius, leaves, budget)
    return met, at + number, begin, budget


@first_in.of(Rows)
def first_in_rows(
    entry: Any, at: float, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int
) -> tuple[float, float, Vec3, int]:
    share, index, where = NO_HIT, at, start
    for i in range(len(entry)):
        met, place, begin, budget = meets_it(element(entry, i), at + i, start, end, radius, leaves, skip, budget)
        if met < share:
            share, index, where = met, place, begin
    return share, index, where, budget


@jit
def first_hit(
    objects: Any, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int
) -> tuple[float, Vec3, int]:
    """Place of the first object met, -1 for none, where (3,) m its surface and the fingertip meet, and what is left of
    the budget; where that is used up on a mesh or a height map it counts as met.

    start   (3,) m  where the way begins, at the last tick: an object that has moved since has taken it along
    end     (3,) m  where the way ends now
    leaves          see `travel`
    skip            places of up to three objects that are not asked
    budget          nodes and triangles of meshes, and tiles of height maps, that may be asked
    """
    share, index, where = NO_HIT, -1.0, end
    at = 0.0
    for entry in literal_unroll(objects):
        met, place, begin, budget = first_in(entry, at, start, end, radius, leaves, skip, budget)
        if met < share:
            share, index, where = met, place, vec3.add_scaled(begin, met, vec3.sub(end, begin))
        at += count(entry)
    return index, where, budget
