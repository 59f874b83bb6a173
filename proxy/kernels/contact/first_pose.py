"""First pose of a fingertip, which may be inside an object: the object it touches, and a position outside.

There is no path to sweep, so a mesh is searched completely, once, with a larger budget than that of other ticks. If the
result is still unknown, `detection` reports it, and the next tick's pose is treated as the first again.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import NONE, SmoothSearch, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.kinds import has_creases_at, has_creases_near, has_mesh
from softfinger.proxy.kernels.query.objects import NO_OBJECTS, find_closest_within, find_deepest, is_near_mesh
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE_TOLERANCE, QUEUE_SIZE
from softfinger.proxy.kernels.shapes.composite import NO_LIMIT_M, raised_clear

OVERLAP_TOLERANCE = 1e-4
"""Overlap with a mesh, as a share of the radius, that counts as clear if the nearest triangle cannot be found: larger
than the rounding of a bound."""
MAX_RISES = 16
"""Heights over a mesh that are tried for a fingertip that starts inside."""
FIRST_RISE, RISE_GROWTH = 1e-5, 4.0
"""Smallest step from the first height to the second, as a share of the radius, and its growth factor per height."""


class FirstTouch(NamedTuple):
    """Object touched by the first pose.

    object_index  -1 for none
    is_known      False if the search did not finish
    budget        remaining budget, below 0 if it was exhausted
    """

    object_index: float
    is_known: bool
    budget: int


@jit
def find_first_touch(objects: Any, radius: float, position: Vec3, budget: int) -> FirstTouch:
    """Return the object that a fingertip starting at `position` (3,) m touches.

    budget  for height maps, and for meshes in a scene with a height map
    """
    if isinstance(objects.search, SmoothSearch):
        gap, index, budget = find_deepest(objects, position, NO_LIMIT_M, NO_OBJECTS, budget)
        return FirstTouch(index if gap < radius else NONE, True, budget)
    if has_creases_near(objects):  # a search nearby is enough for the side of a height map
        gap, index, budget = find_deepest(objects, position, radius, NO_OBJECTS, budget)
        if has_mesh(objects) and gap >= radius:
            gap, index, budget = find_deepest(objects, position, NO_LIMIT_M, NO_OBJECTS, budget)
            if has_creases_at(objects, index):  # only a bound: the first search found it farther away
                index = NONE
    else:  # the side of a mesh needs a search of all of it
        gap, index, budget = find_deepest(objects, position, NO_LIMIT_M, NO_OBJECTS, QUEUE_SIZE)
    if budget < 0 and index >= 0.0 and not has_creases_at(objects, index):
        # The search of a mesh did not finish, so the gap was a bound. Use the nearest triangle found so far.
        gap, _, _, budget = find_closest_within(objects, index, position, budget)
        if gap >= radius and not has_creases_near(objects):
            gap, nearer, budget = find_deepest(
                objects, position, radius * (1.0 - OVERLAP_TOLERANCE), NO_OBJECTS, QUEUE_SIZE
            )
            if budget < 0:
                return FirstTouch(NONE, False, budget)
            index = nearer if gap < radius else index
    return FirstTouch(index if gap < radius else NONE, True, budget)


@jit
def raise_outside(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> tuple[Vec3, bool]:
    """Return a position (3,) m outside for a fingertip that is inside at `center`, and True if one was found.

    index   of an object that the fingertip touches there
    normal  (3,)  of that object there

    Near a mesh, it is the first position along the normal that is outside of all objects.
    """
    if (
        isinstance(objects.search, SmoothSearch)
        or has_creases_near(objects)
        or not is_near_mesh(objects, center, 2.0 * radius)
    ):
        body = find_object(objects, index)
        return out_of(body.pose, raised_clear(body.shape, into(body.pose, center), radius)), True
    height, step, room = 0.0, FIRST_RISE * radius, QUEUE_SIZE
    for _ in range(MAX_RISES):
        position = vec3.add_scaled(center, height, normal)
        gap, _, budget = find_deepest(objects, position, radius, NO_OBJECTS, min(room, BUDGET))
        room -= min(room, BUDGET) - max(budget, 0)
        if budget >= 0 and gap >= radius * (1.0 - INSIDE_TOLERANCE):  # cuts no triangle; the side needs a search of all
            gap, _, budget = find_deepest(objects, position, NO_LIMIT_M, NO_OBJECTS, min(room, BUDGET))
            room -= min(room, BUDGET) - max(budget, 0)
            if budget >= 0 and gap >= radius * (1.0 - INSIDE_TOLERANCE):
                return position, True
        if room <= 0:
            break
        height += max(radius - gap if budget >= 0 else 0.0, step)
        step *= RISE_GROWTH
    return center, False
