"""A contact before friction: a first touch, or the only contact of the last tick, carried along and rolled."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import (
    any_moves,
    carried_direction,
    carried_point,
    carry_of,
    relative_rotation,
)
from softfinger.proxy.kernels.contact.contact_friction import Prediction
from softfinger.proxy.kernels.contact.first_pose import raised, touched_at_first
from softfinger.proxy.kernels.contact.rest.active_set import INSIDE, one_constraint
from softfinger.proxy.kernels.contact.rest.alone import settle_on_one
from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll
from softfinger.proxy.kernels.contact.rolling.on_objects import follows_on, roll_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.tuples import first_of, replace, same_for
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NONE,
    ActiveSet,
    Constraint,
    Finger,
    FingerState,
    Probe,
    Quaternion,
    Scene,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.query.kinds import (
    SINGLE_POINT,
    WITH_HEIGHTMAP,
    WITH_MESH,
    any_creases,
    any_mesh,
    by_multipoint,
    is_mesh_at,
)
from softfinger.proxy.kernels.query.motion import carried_along
from softfinger.proxy.kernels.query.objects import (
    NOBODY,
    closest_to_within,
    deepest,
    is_inside,
    slides_round_hollow,
)
from softfinger.proxy.kernels.query.sweep import first_hit
from softfinger.proxy.kernels.shapes import is_hollow, transport, travel
from softfinger.proxy.kernels.shapes.budget import BUDGET, ROOM, SPENT
from softfinger.proxy.kernels.shapes.composite import EVERYWHERE
from softfinger.proxy.record import FREE, ROLLING

STUCK_TICKS = 8
"""Ticks in a row without rest in which a proxy beside a mesh stands still before it starts anew where the probe is."""


NO_PREDICTION = Prediction(NO_CONTACT, (0.0, 0.0, 0.0), 0.0, False)
"""A place for a prediction, with no contact in it."""


class Meeting(NamedTuple):
    """A first touch.

    start    (3,) m  where the way of the proxy begins
    met      (3,) m  where the object that is met holds it
    center   (3,) m  the same, or over the probe
    active           what is met, if anything
    over             `center` is over the probe
    budget           what is left for the tick, below 0 if it is not known whether a first pose touches anything
    """

    start: Vec3
    met: Vec3
    center: Vec3
    active: ActiveSet
    over: bool
    budget: int


class Approach(NamedTuple):
    """What holds the proxy at the beginning of a tick, before friction; the first constraint is of no object if nothing
    does.

    start        (3,) m  where the way of the proxy in this tick begins, see `first_hit`
    outside      (3,) m  where the proxy is known to be outside of all objects
    center       (3,) m  the proxy, with the roll of the only contact
    active               the constraints at `center`
    predicted            a Prediction for each contact
    rolled       rad     roll angle since touch
    strays               the roll is in the deflection only, and `center` has not gone along
    single               one contact, whose way over its object is known: friction comes before the others are asked
    began                the contact begins in this tick
    bounded              1 if a roll was stopped since the budget was used up
    budget               left for the search
    stuck                ticks in a row before this one in which the proxy found no rest
    """

    start: Vec3
    outside: Vec3
    center: Vec3
    active: ActiveSet
    predicted: Any
    rolled: float
    strays: bool
    single: bool
    began: bool
    bounded: float
    budget: int
    stuck: float


@jit
def first_rest(objects: Any, radius: float, position: Vec3, met: Vec3, active: ActiveSet) -> Vec3:
    """Where the proxy (3,) m of a contact begins that was met at `met`."""
    body = object_at(objects, active[0].body)
    return rest_over_the_probe(body, radius, position, met, active[0])


@jit
def rest_over_the_probe(body: Any, radius: float, position: Vec3, met: Vec3, constraint: Constraint) -> Vec3:
    """Over the probe, at the depth along the normal of where it was met; there, where the surface bends another way."""
    over = vec3.add(position, vec3.scale(constraint.depth, constraint.normal))
    return over if follows_on(body, radius, OffsetPoint(met, constraint.normal), over) else met


@jit
def is_outside(objects: Any, radius: float, start: Vec3, position: Vec3, budget: int) -> bool:
    """Whether the fingertip at `position` touches nothing, but for rounding, on the side where it was at `start`.

    Facets have no other side that a gap would tell: between two places that are outside of them, only a way below two
    radii leads through none.
    """
    if any_mesh(objects):
        way = vec3.sub(position, start)
        if vec3.dot(way, way) >= (2.0 * radius) ** 2:
            return False
    gap, _, _ = deepest(objects, position, radius, NOBODY, budget)
    return gap >= radius * (1.0 - INSIDE)


@by_multipoint
def exact_touch(objects: Any, index: float, start: Vec3, end: Vec3, radius: float, met: Vec3, budget: int) -> Any:
    """Where (3,) m a way meets the object with that place, as if there were no other; False if others are in the way,
    or if it is not known. `met` is where the search of all objects has met it."""


@exact_touch.of(SINGLE_POINT)
def touch_of_a_shape(
    objects: Any, index: float, start: Vec3, end: Vec3, radius: float, met: Vec3, budget: int
) -> tuple[Vec3, bool]:
    return met, True


@exact_touch.of(WITH_HEIGHTMAP)
def touch_beside_a_heightmap(
    objects: Any, index: float, start: Vec3, end: Vec3, radius: float, met: Vec3, budget: int
) -> tuple[Vec3, bool]:
    return met, not is_mesh_at(objects, index)


@exact_touch.of(WITH_MESH)
def touch_of_a_facet(
    objects: Any, index: float, start: Vec3, end: Vec3, radius: float, met: Vec3, budget: int
) -> tuple[Vec3, bool]:
    """A mesh is searched along the way in steps of its clearance, which may end a little before the touch."""
    body = object_at(objects, index)
    begin = carried_along(body, start)
    share = travel(body.shape, into(body.pose, begin), into(body.pose, end), radius, False)
    found = vec3.add_scaled(begin, min(share, 1.0), vec3.sub(end, begin))
    return found, is_outside(objects, radius, found, found, budget)


@jit
def is_clear(objects: Any, radius: float, position: Vec3) -> bool:
    """Whether a fingertip there touches no mesh and nothing else, on the outer side of what is closed."""
    if not any_mesh(objects):
        return False
    gap, _, left = deepest(objects, position, EVERYWHERE, NOBODY, ROOM)
    return left >= 0 and gap >= radius


@jit
def detect_among_several(finger: Finger, objects: Any, state: FingerState, position: Vec3) -> Meeting:
    """First contact on the way of the last proxy, in free space the last probe, to the probe, as each object sees it.

    The whole way is swept, so a thin object is not jumped over, nor does it jump over a finger that rests. The first
    pose of all has no way: it is in contact where it stands inside.
    """
    radius = finger.radius
    start, budget = position, BUDGET // 2
    if any_creases(objects):  # on the way over a height map a fingertip asks more often
        budget = 3 * BUDGET // 4
    left, nothing = budget, one_constraint(NONE, (0.0, 0.0, 1.0), 0.0)
    if state.started == 0.0:
        index, known, left = touched_at_first(objects, radius, position, left)
        if not known:
            return Meeting(start, position, position, nothing, False, SPENT)
        met = position
    else:
        start = state.center
        index, met, left = first_hit(objects, start, position, radius, False, NOBODY, left)
    active, center, exact = nothing, position, False
    if index >= 0.0:
        gap, point, normal, left = closest_to_within(objects, index, met, left)
        center = vec3.add_scaled(point, radius, normal)
        together = any_mesh(objects)
        touch, exact = exact_touch(objects, index, start, position, radius, met, left)
        if state.started != 0.0 and together:
            # Others may be as near, or the way was not searched to the end: on this one it might be inside.
            center = met
            if exact:
                _, point, normal, left = closest_to_within(objects, index, touch, left)
                center = vec3.add_scaled(point, radius, normal)
        elif (state.started == 0.0 or gap < radius * (1.0 - INSIDE)) and not is_outside(
            objects, radius, center, center, left
        ):  # the gap is a bound, of a map that was not searched to the end; or another triangle is as near
            if state.started != 0.0:
                center = met
            else:
                center, known = raised(objects, index, radius, center, normal)
                if not known:
                    return Meeting(start, position, position, nothing, False, SPENT)
        depth = max(vec3.dot(vec3.sub(center, position), normal), 0.0)
        active = one_constraint(index, normal, depth)
        ended = state.mode != FREE and depth <= INSIDE * radius
        if ended and is_outside(objects, radius, state.center, position, left):
            active, center = nothing, position  # what has just ended, rounded
    place, over = center, active[0].body >= 0.0 and exact
    if over:
        place = first_rest(objects, radius, position, center, active)
    if len(state.contacts) > 1 and any_creases(objects) and state.started != 0.0 and active[0].body >= 0.0:
        center = met  # of a map that was not searched to the end the gap is a bound
    if not any_moves(objects):
        start = center
    # What a mesh was asked on the way is not counted twice: see `BUDGET`.
    left = BUDGET - budget + max(left, 0) if any_creases(objects) else BUDGET
    return Meeting(start, center, place, active, over, left)


@jit
def detect_contact(finger: Finger, objects: Any, state: FingerState, probe: Probe) -> Approach:
    """A first touch."""
    met = detect_among_several(finger, objects, state, probe.position)
    center, active = met.center, met.active
    body = active[0].body
    if body >= 0.0 and met.over and is_inside(objects, body):
        # The wall may be far along the normal of where it was met. Nothing is wound yet: the nearest place is right.
        center, active, _ = settle_on_one(
            objects, body, finger.radius, probe.position, center, (0.0, 0.0, 0.0), active[0].normal
        )
    contact = replace(
        state.contacts[0], "body", body, "normal", active[0].normal, "push", active[0].depth, "share", 1.0,
        "mode", float(ROLLING),
    )  # fmt: skip
    return Approach(
        start=met.start,
        outside=met.met,
        center=center,
        active=active,
        predicted=first_of(state.contacts, Prediction(contact, (0.0, 0.0, 0.0), 0.0, True), NO_PREDICTION),
        rolled=state.rolled,
        strays=not met.over,
        single=met.over,
        began=True,
        bounded=0.0,
        budget=met.budget,
        stuck=state.stuck,
    )


@by_type
def in_hollow(
    method: Any,
    body: Any,
    radius: float,
    position: Vec3,
    start: OffsetPoint,
    turn: Quaternion,
    rolled: Roll,
) -> Any:
    """What a roll from `start` is for the coupling in a hollow; elsewhere it is as `rolled` says.

    returns  Roll, what of it (3,) m the centre has not gone along, whether that is all of it
    """


@in_hollow.of(None)
def no_roll_in_hollow(
    method: None,
    body: Any,
    radius: float,
    position: Vec3,
    start: OffsetPoint,
    turn: Quaternion,
    rolled: Roll,
) -> tuple[Roll, Vec3, bool]:
    nothing = (-0.0, -0.0, -0.0)
    if follows_on(body, radius, start, rolled.center):
        return rolled, nothing, False
    return Roll(start.center, start.normal, (0.0, 0.0, 0.0), 0.0, rolled.spin, True), nothing, True


@in_hollow.otherwise
def roll_in_hollow(
    method: Any,
    body: Any,
    radius: float,
    position: Vec3,
    start: OffsetPoint,
    turn: Quaternion,
    rolled: Roll,
) -> tuple[Roll, Vec3, bool]:
    center, normal = start
    beyond = (-0.0, -0.0, -0.0)
    strays = not rolled.whole or slides_round_hollow(body, radius, center, normal, rolled.theta)
    strays = strays or not follows_on(body, radius, start, rolled.center)
    if strays:  # the roll winds the coupling in the tangent plane, and the centre goes where friction lets it
        theta, axis = rotations.tilt(turn, normal)
        beyond = vec3.scale(radius * theta, vec3.cross(axis, normal))
        rolled = Roll(center, normal, beyond, theta, rotations.twist(turn, normal), rolled.whole)
    elif is_hollow(body.shape):
        # The normal that turns makes a tangent part of the depth: u (1 + depth / (R - r)) in a round hollow.
        begun = vec3.reject(vec3.sub(center, position), normal)
        ended = vec3.reject(vec3.sub(rolled.center, position), rolled.normal)
        wound = vec3.sub(ended, transport(body.shape, begun, normal, rolled.normal))
        rolled = Roll(rolled.center, rolled.normal, wound, rolled.theta, rolled.spin, True)
    return rolled, beyond, strays


@jit
def continue_contact(
    scene: Scene, finger: Finger, body: Any, index: float, state: FingerState, probe: Probe, dt: float
) -> Approach:
    """The only contact goes with its object and rolls by what the fingertip turned against it."""
    radius, position, last = finger.radius, probe.position, state.contacts[0]
    carried = carry_of(body)
    old_normal, moved = carried_direction(carried, last.normal), carried_point(carried, state.center)
    turn = relative_rotation(carried, rotations.relative(probe.orientation, state.probe.orientation))
    rolled = roll_on(scene.rolling, body, radius, moved, old_normal, turn)
    begun = OffsetPoint(moved, old_normal)
    whole = rolled.whole
    rolled, beyond, strays = in_hollow(scene.rolling, body, radius, position, begun, turn, rolled)
    center, normal = rolled.center, rolled.normal
    rolled_part = transport(body.shape, carried_direction(carried, last.rolled_part), old_normal, normal)
    before = transport(body.shape, carried_direction(carried, last.deflection), old_normal, normal)
    behind = vec3.sub(center, position)
    depth = max(vec3.dot(behind, normal), 0.0)
    contact = replace(
        last, "body", index, "normal", normal, "push", depth, "share", 1.0, "mode", state.mode, "deflection", before,
        "rolled_part", vec3.add(rolled_part, rolled.motion), "bend", carried_direction(carried, last.bend),
    )  # fmt: skip
    deflection = vec3.add(vec3.sub(behind, vec3.scale(depth, normal)), beyond)
    return Approach(
        start=state.center,
        outside=moved,
        center=center,
        active=one_constraint(index, normal, depth),
        predicted=first_of(state.contacts, Prediction(contact, deflection, rolled.spin, False), NO_PREDICTION),
        rolled=state.rolled + rolled.theta,
        strays=strays,
        single=True,
        began=False,
        bounded=0.0 if whole else 1.0,
        budget=BUDGET,
        stuck=state.stuck,
    )


@jit
def detect_or_continue(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, probe: Probe, dt: float
) -> tuple[FingerState, Approach]:
    """The contact with the only object goes on; if it has ended, what is met in the same tick is another one. The
    state returned is without the contact that has ended."""
    if state.mode != FREE:
        approach = continue_contact(scene, finger, object_at(objects, 0.0), 0.0, state, probe, dt)
        if not has_ended(approach.active):
            return state, approach
    state = separated(state)
    return state, detect_contact(finger, objects, state, probe)


@jit
def has_ended(active: ActiveSet) -> bool:
    """Whether nothing pushes: a probe that has popped through a thin body is outside of it and still active."""
    return not (active[0].depth > 0.0 or active[1].depth > 0.0 or active[2].depth > 0.0)


@jit
def separated(state: FingerState) -> Any:
    """The state without what was wound up in the contact that has ended."""
    return replace(state, "contacts", same_for(state.contacts, NO_CONTACT), "rolled", 0.0, "stuck", 0.0)
