"""Which object a fingertip meets first on its way: nothing thin is jumped over in a tick, whoever moves.

The way is the one that the object sees: straight, in its own frame, from where the fingertip was to where it is.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import STILL, Many, Single, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.query.container import ENTRIES, is_beyond, object_at
from softfinger.proxy.kernels.query.motion import carried_along
from softfinger.proxy.kernels.shapes import NO_HIT
from softfinger.proxy.kernels.shapes.protocol import meets


@by_type
def first_hit(objects: Any, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int) -> Any:
    """Index of the first object met, -1 for none, where (3,) m its surface and the fingertip meet, and what is left of
    the budget; where that is used up on a mesh or a height map it counts as met.

    start   (3,) m  where the way begins, at the last tick: an object that has moved since has taken it along
    end     (3,) m  where the way ends now
    leaves          see `travel`
    skip            indices of up to three objects that are left out
    budget          nodes and triangles of meshes, and tiles of height maps, that may be asked
    """


@jit
def meets_it(
    body: Any, start: Vec3, end: Vec3, radius: float, leaves: bool, budget: int
) -> tuple[float, float, Vec3, int]:
    """Share of the way at which an object is met, the index of its triangle, where (3,) m, and the budget left."""
    begin = carried_along(body, start)
    met, facet, budget = meets(body.shape, into(body.pose, begin), into(body.pose, end), radius, leaves, budget)
    return met, facet, vec3.add_scaled(begin, met, vec3.sub(end, begin)), budget


@first_hit.of(Single)
def first_hit_of_one(
    objects: Single, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int
) -> tuple[float, Vec3, int]:
    if skip[0] == 0.0 or skip[1] == 0.0 or skip[2] == 0.0:
        return -1.0, end, budget
    met, facet, where, budget = meets_it(objects.body, start, end, radius, leaves, budget)
    return (facet, where, budget) if met < NO_HIT else (-1.0, end, budget)


@first_hit.of(Many)
def first_hit_of_many(
    objects: Many, start: Vec3, end: Vec3, radius: float, leaves: bool, skip: Any, budget: int
) -> tuple[float, Vec3, int]:
    share, index, where = NO_HIT, -1.0, end
    near = radius + vec3.norm(vec3.sub(end, start))
    for row in range(int(objects.size)):
        at = float(row)
        if at == skip[0] or at == skip[1] or at == skip[2]:
            continue
        entry = objects.entries[row]
        if entry.motion.kind == STILL and is_beyond(objects, row, start, near):
            continue
        met, facet, place, budget = meets_it(object_at(objects, at), start, end, radius, leaves, budget)
        if met < share:
            share, index, where = met, at + ENTRIES * facet, place
    return index, where, budget
