"""First object that a fingertip hits on its path in a tick, so that neither can pass through the other.

The path is straight in the frame of each object, from the fingertip's last position to its current one. So a thin
object that moves is detected, too.
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
    """Find the first hit in the entry that starts at index `at`: see `first_hit`.

    returns  share of the path at the hit, flat index of the object, start (3,) m of the path, and remaining budget
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
    """Find the first object that a fingertip hits on its path.

    start   (3,) m  start of the path, at the last tick; for an object that has moved since, it moves with the object
    end     (3,) m  end of the path, now
    leaves          see `travel`
    skip            flat indices of up to three objects to ignore
    budget          nodes and triangles of meshes, and tiles of height maps, that may be visited
    returns         flat index of the object, -1 for none; the fingertip's centre (3,) m at the hit; and the remaining
                    budget. A mesh or height map whose query exhausts the budget counts as hit
    """
    share, index, where = NO_HIT, -1.0, end
    at = 0.0
    for entry in literal_unroll(objects):
        met, place, begin, budget = first_in(entry, at, start, end, radius, leaves, skip, budget)
        if met < share:
            share, index, where = met, place, vec3.add_scaled(begin, met, vec3.sub(end, begin))
        at += count(entry)
    return index, where, budget
