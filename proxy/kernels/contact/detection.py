"""Detection of a first contact on the fingertip's path in free space."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import NO_PREDICTION, Approach
from softfinger.proxy.kernels.contact.contact_friction import Prediction
from softfinger.proxy.kernels.contact.first_pose import find_first_touch, raise_outside
from softfinger.proxy.kernels.contact.rest.active_set import make_single_constraint
from softfinger.proxy.kernels.contact.rest.one_object import settle_on_one
from softfinger.proxy.kernels.contact.rolling import OffsetPoint
from softfinger.proxy.kernels.contact.rolling.on_objects import can_follow
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of, replace
from softfinger.proxy.kernels.model import (
    NONE,
    ActiveSet,
    Constraint,
    FacetedSearch,
    Finger,
    FingerState,
    Probe,
    Single,
    SmoothSearch,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.query.carry import has_moving_object, make_carry, move_point
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.kinds import has_creases_near, is_mesh_at
from softfinger.proxy.kernels.query.objects import (
    NO_OBJECTS,
    find_closest_within,
    find_deepest,
    is_inside,
    is_near_mesh,
)
from softfinger.proxy.kernels.query.sweep import find_first_hit
from softfinger.proxy.kernels.shapes import travel
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE_TOLERANCE, NO_BUDGET, QUEUE_SIZE
from softfinger.proxy.record import FREE, ROLLING


class Touch(NamedTuple):
    """Fingertip where it touches an object.

    center         (3,) m  centre of the fingertip
    normal         (3,)    of the object
    is_path_clear          True if no other object obstructs the path to it
    is_known               False if it is unknown whether a first pose touches anything
    budget                 remaining budget
    """

    center: Vec3
    normal: Vec3
    is_path_clear: bool
    is_known: bool
    budget: int


class FirstContact(NamedTuple):
    """First contact.

    start         (3,) m  start of the proxy's path in this tick
    touch_center  (3,) m  proxy in contact with the object that was hit
    center        (3,) m  the same, or above the probe
    active                constraint of the object that was hit, if any
    is_above_probe        True if `center` is above the probe
    budget                remaining for the tick, below 0 if it is unknown whether a first pose touches anything
    """

    start: Vec3
    touch_center: Vec3
    center: Vec3
    active: ActiveSet
    is_above_probe: bool
    budget: int


@jit
def place_above_probe(objects: Any, radius: float, position: Vec3, touch: Vec3, constraint: Constraint) -> Vec3:
    """Return the proxy (3,) m above the probe, at the depth along the normal, of a contact detected at `touch` (3,) m.

    If the proxy cannot roll to that position (`can_follow`), return `touch`.
    """
    body = find_object(objects, constraint.object_index)
    above_probe = vec3.add(position, vec3.scale(constraint.depth, constraint.normal))
    return above_probe if can_follow(body, radius, OffsetPoint(touch, constraint.normal), above_probe) else touch


@jit
def is_outside(objects: Any, radius: float, start: Vec3, position: Vec3, budget: int) -> bool:
    """Return True if the fingertip at `position` touches nothing, up to rounding, on the same side as at `start`.

    The gap to a facet does not show the side. Between two positions outside of all facets, only a path shorter than
    two radii is certain to cross none.
    """
    length = vec3.norm(vec3.sub(position, start))
    if length >= 2.0 * radius and is_near_mesh(objects, position, radius + length):
        return False
    gap, _, _ = find_deepest(objects, position, radius, NO_OBJECTS, budget)
    return gap >= radius * (1.0 - INSIDE_TOLERANCE)


@jit
def refine_touch(
    objects: Any, index: float, start: Vec3, end: Vec3, radius: float, hit_center: Vec3, near_mesh: bool, budget: int
) -> tuple[Vec3, bool]:
    """Return the position (3,) m on the path where object `index` would be touched if it were the only one, and a flag.

    hit_center  (3,) m  touch found by the search of all objects
    near_mesh           True if a mesh may be touched on the path

    The flag is False if another object obstructs the path, or if this is unknown. Near a mesh, one facet is
    swept: the search of a mesh moves in steps of its clearance, and may end a little before the touch.
    """
    if isinstance(objects, Single) and not isinstance(objects.search, FacetedSearch):
        return hit_center, True
    if isinstance(objects.search, SmoothSearch) or has_creases_near(objects) or not near_mesh:
        return hit_center, not is_mesh_at(objects, index)
    body = find_object(objects, index)
    path_start = move_point(make_carry(body), start)
    share = travel(body.shape, into(body.pose, path_start), into(body.pose, end), radius, False)
    touch = vec3.add_scaled(path_start, min(share, 1.0), vec3.sub(end, path_start))
    return touch, is_outside(objects, radius, touch, touch, budget)


@jit
def is_clear(objects: Any, radius: float, position: Vec3) -> bool:
    """Return True if the fingertip is known to touch nothing, and to be outside of all closed objects.

    Not needed for a single smooth object, on which the proxy is never stuck. Near a height map an exhausted budget is
    accepted: far below its limit a search returns a bound of the distance.
    """
    if isinstance(objects, Single) and isinstance(objects.search, SmoothSearch):
        return False
    touch = find_first_touch(objects, radius, position, QUEUE_SIZE)
    is_known = touch.is_known if has_creases_near(objects) else touch.budget >= 0
    return is_known and touch.object_index < 0.0


@jit
def place_at_touch(
    objects: Any, index: float, radius: float, start: Vec3, end: Vec3, hit_center: Vec3, is_first: bool, budget: int
) -> Touch:
    """Return the fingertip in contact with object `index`, which the search hit at `hit_center` (3,) m on the path.

    is_first  True for the first pose, which has no path and may be inside the object
    """
    gap, point, normal, budget = find_closest_within(objects, index, hit_center, budget)
    center = vec3.add_scaled(point, radius, normal)
    reach = radius + vec3.norm(vec3.sub(end, start))
    near_mesh = is_mesh_at(objects, index) or is_near_mesh(objects, end, reach)
    touch, is_path_clear = refine_touch(objects, index, start, end, radius, hit_center, near_mesh, budget)
    if near_mesh and not is_first:
        # Other facets may be equally near, or the search did not finish: on this one it might be inside another.
        if not is_path_clear:
            return Touch(hit_center, normal, False, True, budget)
        _, point, normal, budget = find_closest_within(objects, index, touch, budget)
        return Touch(vec3.add_scaled(point, radius, normal), normal, True, True, budget)
    # The gap may be a bound, because the search of a height map did not finish, or another triangle is equally near.
    may_be_inside = is_first or gap < radius * (1.0 - INSIDE_TOLERANCE)
    is_known = True
    if may_be_inside and not is_outside(objects, radius, center, center, budget):
        if is_first:
            center, is_known = raise_outside(objects, index, radius, center, normal)
        else:
            center = hit_center
    return Touch(center, normal, is_path_clear, is_known, budget)


@jit
def detect_among_several(finger: Finger, objects: Any, state: FingerState, position: Vec3) -> FirstContact:
    """Find the first contact on the path from the last proxy (in free space, the last probe) to the probe.

    The complete path relative to each object is swept, so the finger cannot skip a thin object, and a moving thin
    object cannot skip a finger at rest. The first pose has no path: it is in contact if it is inside an object.
    """
    radius, is_first = finger.radius, state.started == 0.0
    start, budget = position, BUDGET // 2
    has_creases = has_creases_near(objects)
    if has_creases:  # a path over a height map takes more queries
        budget = 3 * BUDGET // 4
    remaining, nothing = budget, make_single_constraint(NONE, (0.0, 0.0, 1.0), 0.0)
    unknown = FirstContact(start, position, position, nothing, False, NO_BUDGET)
    if is_first:
        index, is_known, remaining = find_first_touch(objects, radius, position, remaining)
        if not is_known:
            return unknown
        hit_center = position
    else:
        start = state.center
        index, hit_center, remaining = find_first_hit(objects, start, position, radius, False, NO_OBJECTS, remaining)
    active, center, is_above_probe = nothing, position, False
    if index >= 0.0:
        touch = place_at_touch(objects, index, radius, start, position, hit_center, is_first, remaining)
        if not touch.is_known:
            return unknown
        remaining = touch.budget
        depth = max(vec3.dot(vec3.sub(touch.center, position), touch.normal), 0.0)
        may_be_released = state.mode != FREE and depth <= INSIDE_TOLERANCE * radius
        # Otherwise this would be the contact just released, up to rounding.
        if not (may_be_released and is_outside(objects, radius, state.center, position, remaining)):
            active = make_single_constraint(index, touch.normal, depth)
            center, is_above_probe = touch.center, touch.is_path_clear
    proxy = place_above_probe(objects, radius, position, center, active[0]) if is_above_probe else center
    if has_creases and len(state.contacts) > 1 and not is_first and active[0].object_index >= 0.0:
        center = hit_center  # the gap is only a bound if the search of a height map did not finish
    if not has_moving_object(objects):
        start = center
    # Without a height map, the search of the path does not reduce the budget of the rest position: see `BUDGET`.
    remaining = BUDGET - budget + max(remaining, 0) if has_creases else BUDGET
    return FirstContact(start, center, proxy, active, is_above_probe, remaining)


@jit
def detect_contact(finger: Finger, objects: Any, state: FingerState, probe: Probe) -> Approach:
    """Detect a first contact, and compute the rest position of its proxy."""
    first = detect_among_several(finger, objects, state, probe.position)
    center, active = first.center, first.active
    body = active[0].object_index
    if body >= 0.0 and first.is_above_probe and is_inside(objects, body):
        # The wall may be far away along the normal of the first touch. Nothing is wound up: use the nearest point.
        center, active, _ = settle_on_one(
            objects, body, finger.radius, probe.position, center, (0.0, 0.0, 0.0), active[0].normal
        )
    contact = replace(
        state.contacts[0], "object_index", body, "normal", active[0].normal, "push", active[0].depth, "share", 1.0,
        "mode", float(ROLLING),
    )  # fmt: skip
    return Approach(
        start=first.start,
        clear_center=first.touch_center,
        center=center,
        active=active,
        predicted=first_of(state.contacts, Prediction(contact, (0.0, 0.0, 0.0), 0.0, True), NO_PREDICTION),
        rolled=state.rolled,
        center_lacks_roll=not first.is_above_probe,
        is_single=first.is_above_probe,
        is_new=True,
        budget_exhausted=0.0,
        budget=first.budget,
        stuck_ticks=state.stuck_ticks,
    )
