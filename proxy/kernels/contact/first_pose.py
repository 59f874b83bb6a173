"""The first pose of a fingertip, which may begin inside: what it touches, and where outside is.

It has no way that could be swept, so all of a mesh is asked, once, with a larger budget than other ticks have. What is
not known then is said, and the next tick's pose is the first again.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.rest.active_set import INSIDE
from softfinger.proxy.kernels.model import NONE, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.kinds import (
    SINGLE_POINT,
    WITH_MESH,
    any_creases,
    any_mesh,
    by_multipoint,
    has_creases_at,
)
from softfinger.proxy.kernels.query.objects import NOBODY, closest_to_within, deepest, raised_clear_of
from softfinger.proxy.kernels.shapes.budget import BUDGET, ROOM
from softfinger.proxy.kernels.shapes.composite import EVERYWHERE

GRAZE = 1e-4
"""Share of the radius by which a fingertip may touch a mesh and count as clear, where its nearest triangle cannot be
found: more than a bound is off by rounding."""
RISES = 16
"""Heights over a mesh at which a fingertip that begins inside is tried."""
RISE, RISES_BY = 1e-5, 4.0
"""Share of the radius from the first of them to the second, at least; and what that grows by from each to the next."""


class Touched(NamedTuple):
    """Place of the object that is touched, -1 for none; whether that is known; what is left of the budget, below 0
    where it was used up."""

    place: float
    known: bool
    budget: int


@by_multipoint
def touched_at_first(objects: Any, radius: float, position: Vec3, budget: int) -> Any:
    """What a fingertip touches that begins at `position` (3,) m; with the `budget` for height maps, and for meshes
    beside them."""


@touched_at_first.of(SINGLE_POINT)
def touched_in_one_point(objects: Any, radius: float, position: Vec3, budget: int) -> Touched:
    gap, index, budget = deepest(objects, position, EVERYWHERE, NOBODY, budget)
    return Touched(index if gap < radius else NONE, True, budget)


@touched_at_first.otherwise
def touched_in_many_points(objects: Any, radius: float, position: Vec3, budget: int) -> Touched:
    if any_creases(objects):  # a height map tells its side from near by
        gap, index, budget = deepest(objects, position, radius, NOBODY, budget)
        if any_mesh(objects) and gap >= radius:
            gap, index, budget = deepest(objects, position, EVERYWHERE, NOBODY, budget)
            if has_creases_at(objects, index):  # its bound: it has just been found to be farther
                index = NONE
    else:  # of a mesh all has to be asked for that
        gap, index, budget = deepest(objects, position, EVERYWHERE, NOBODY, ROOM)
    if budget < 0 and index >= 0.0 and not has_creases_at(objects, index):
        # A mesh was not searched to the end: the gap was a bound. This is that of the nearest triangle found so far.
        gap, _, _, budget = closest_to_within(objects, index, position, budget)
        if gap >= radius and not any_creases(objects):
            gap, nearer, budget = deepest(objects, position, radius * (1.0 - GRAZE), NOBODY, ROOM)
            if budget < 0:
                return Touched(NONE, False, budget)
            index = nearer if gap < radius else index
    return Touched(index if gap < radius else NONE, True, budget)


@by_multipoint
def raised(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> Any:
    """A place (3,) m outside for a fingertip at `center`, which is inside, on the object with that place where it has
    that normal; and whether there is one."""


@raised.otherwise
def raised_off_object(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> tuple[Vec3, bool]:
    return raised_clear_of(objects, index, center, radius), True


@raised.of(WITH_MESH)
def raised_off_facets(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> tuple[Vec3, bool]:
    """The first place found along the normal that is outside of everything."""
    height, step, left = 0.0, RISE * radius, ROOM
    for _ in range(RISES):
        place = vec3.add_scaled(center, height, normal)
        gap, _, after = deepest(objects, place, radius, NOBODY, min(left, BUDGET))
        left -= min(left, BUDGET) - max(after, 0)
        if after >= 0 and gap >= radius * (1.0 - INSIDE):  # of no triangle; which side that is, only all of them tell
            gap, _, after = deepest(objects, place, EVERYWHERE, NOBODY, min(left, BUDGET))
            left -= min(left, BUDGET) - max(after, 0)
            if after >= 0 and gap >= radius * (1.0 - INSIDE):
                return place, True
        if left <= 0:
            break
        height += max(radius - gap if after >= 0 else 0.0, step)
        step *= RISES_BY
    return center, False
