"""First pose of a fingertip, which may be inside an object: the object it touches, and a position outside.

There is no path to sweep, so a mesh is searched completely, once, with a larger budget than that of other ticks. If the
result is still unknown, `detection` reports it, and the next tick's pose is treated as the first again.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model import NONE, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.query.kinds import (
    SINGLE_POINT,
    WITH_MESH,
    any_creases,
    any_mesh,
    by_multipoint,
    has_creases_at,
)
from softfinger.proxy.kernels.query.objects import NOBODY, closest_to_within, deepest
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE, ROOM
from softfinger.proxy.kernels.shapes.composite import EVERYWHERE, raised_clear

GRAZE = 1e-4
"""Overlap with a mesh, as a share of the radius, that counts as clear if the nearest triangle cannot be found: larger
than the rounding of a bound."""
RISES = 16
"""Heights over a mesh that are tried for a fingertip that starts inside."""
RISE, RISES_BY = 1e-5, 4.0
"""Smallest step from the first height to the second, as a share of the radius, and its growth factor per height."""


class FirstTouch(NamedTuple):
    """Object touched by the first pose.

    place   flat index of the object, -1 for none
    known   False if the search did not finish
    budget  remaining budget, below 0 if it was exhausted
    """

    place: float
    known: bool
    budget: int


@by_multipoint
def first_touch(objects: Any, radius: float, position: Vec3, budget: int) -> Any:
    """Return the object that a fingertip starting at `position` (3,) m touches.

    budget  for height maps, and for meshes in a scene with a height map
    """


@first_touch.of(SINGLE_POINT)
def first_touch_of_smooth(objects: Any, radius: float, position: Vec3, budget: int) -> FirstTouch:
    gap, index, budget = deepest(objects, position, EVERYWHERE, NOBODY, budget)
    return FirstTouch(index if gap < radius else NONE, True, budget)


@first_touch.otherwise
def first_touch_of_any(objects: Any, radius: float, position: Vec3, budget: int) -> FirstTouch:
    if any_creases(objects):  # a search nearby is enough for the side of a height map
        gap, index, budget = deepest(objects, position, radius, NOBODY, budget)
        if any_mesh(objects) and gap >= radius:
            gap, index, budget = deepest(objects, position, EVERYWHERE, NOBODY, budget)
            if has_creases_at(objects, index):  # only a bound: the first search found it farther away
                index = NONE
    else:  # the side of a mesh needs a search of all of it
        gap, index, budget = deepest(objects, position, EVERYWHERE, NOBODY, ROOM)
    if budget < 0 and index >= 0.0 and not has_creases_at(objects, index):
        # The search of a mesh did not finish, so the gap was a bound. Use the nearest triangle found so far.
        gap, _, _, budget = closest_to_within(objects, index, position, budget)
        if gap >= radius and not any_creases(objects):
            gap, nearer, budget = deepest(objects, position, radius * (1.0 - GRAZE), NOBODY, ROOM)
            if budget < 0:
                return FirstTouch(NONE, False, budget)
            index = nearer if gap < radius else index
    return FirstTouch(index if gap < radius else NONE, True, budget)


@by_multipoint
def raise_outside(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> Any:
    """Return a position (3,) m outside for a fingertip that is inside at `center`, and True if one was found.

    index   of an object that the fingertip touches there
    normal  (3,)  of that object there
    """


@raise_outside.otherwise
def raise_off_object(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> tuple[Vec3, bool]:
    body = object_at(objects, index)
    return out_of(body.pose, raised_clear(body.shape, into(body.pose, center), radius)), True


@raise_outside.of(WITH_MESH)
def raise_off_facets(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> tuple[Vec3, bool]:
    """Return the first position along the normal that is outside of all objects."""
    height, step, room = 0.0, RISE * radius, ROOM
    for _ in range(RISES):
        position = vec3.add_scaled(center, height, normal)
        gap, _, budget = deepest(objects, position, radius, NOBODY, min(room, BUDGET))
        room -= min(room, BUDGET) - max(budget, 0)
        if budget >= 0 and gap >= radius * (1.0 - INSIDE):  # cuts no triangle; the side needs a search of all
            gap, _, budget = deepest(objects, position, EVERYWHERE, NOBODY, min(room, BUDGET))
            room -= min(room, BUDGET) - max(budget, 0)
            if budget >= 0 and gap >= radius * (1.0 - INSIDE):
                return position, True
        if room <= 0:
            break
        height += max(radius - gap if budget >= 0 else 0.0, step)
        step *= RISES_BY
    return center, False
