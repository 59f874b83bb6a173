"""What a contact brings into a tick: a first touch, or the old contact on the only object, carried along and rolled."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import (
    any_moves,
    carried_direction,
    carried_point,
    carry_of,
    relative_rotation,
    relative_velocity,
)
from softfinger.proxy.kernels.contact.first_pose import raised, touched_at_first
from softfinger.proxy.kernels.contact.rest.active_set import INSIDE, one_constraint, pressed
from softfinger.proxy.kernels.contact.rest.alone import settle_on_one
from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll
from softfinger.proxy.kernels.contact.rolling.on_objects import follows_on, roll_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_count, by_type
from softfinger.proxy.kernels.jit.tuples import replace, same_for
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NONE,
    ActiveSet,
    Finger,
    FingerState,
    Probe,
    Quaternion,
    Scene,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.kinds import any_creases, any_mesh
from softfinger.proxy.kernels.query.objects import (
    NOBODY,
    closest_to_within,
    deepest,
    slides_round_hollow,
)
from softfinger.proxy.kernels.query.sweep import first_hit
from softfinger.proxy.kernels.shapes import is_hollow, transport
from softfinger.proxy.kernels.shapes.budget import BUDGET, ROOM, SPENT
from softfinger.proxy.kernels.shapes.composite import EVERYWHERE
from softfinger.proxy.record import CAUSE_NONE, CAUSE_TOUCH, FREE, ROLLING

STUCK_TICKS = 8
"""Ticks in a row without rest in which a proxy beside a mesh stands still before it starts anew where the probe is."""


class Meeting(NamedTuple):
    """A first touch: where the way of the proxy begins, where what is met holds it, and what that is, if anything. And
    what is left of the tick's budget, below 0 where it is not known whether a first pose touches anything."""

    start: Vec3
    center: Vec3
    active: ActiveSet
    budget: int


class Approach(NamedTuple):
    """The contact with the only object before friction has its say; the first constraint is of no object where there
    is none.

    deflection, before, rolled_part   (3,) m  e now, e at the last tick and p, tangent to the object
    theta, twist                      rad     roll and spin of the fingertip against the object in this tick
    against                           m/s     probe velocity against the object
    began                             it begins in this tick
    strays                            the roll is in `deflection` only, and `center` has not gone along
    bounded                           1 if that is so because the budget was used up
    """

    mode: float
    cause: float
    center: Vec3
    active: ActiveSet
    deflection: Vec3
    before: Vec3
    rolled_part: Vec3
    theta: float
    twist: float
    against: Vec3
    began: bool
    strays: bool
    bounded: float


@by_count
def rest_of(contacts: Any, objects: Any, radius: float, position: Vec3, met: Vec3, active: ActiveSet) -> Any:
    """Where the proxy (3,) m of a contact begins that was met at `met`."""


@rest_of.of(1)
def rest_over_the_probe(
    contacts: Any, objects: Any, radius: float, position: Vec3, met: Vec3, active: ActiveSet
) -> Vec3:
    _, normal, depth = active[0]
    over = vec3.add(position, vec3.scale(depth, normal))
    return over if follows_on(objects[0], radius, OffsetPoint(met, normal), over) else met


@rest_of.of(2)
def rest_where_it_met(contacts: Any, objects: Any, radius: float, position: Vec3, met: Vec3, active: ActiveSet) -> Vec3:
    """Over the probe there may be another object: `settle_among_several` finds its way there."""
    return met


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
            return Meeting(start, position, nothing, SPENT)
        met = position
    else:
        start = state.center
        index, met, left = first_hit(objects, start, position, radius, False, NOBODY, left)
    active, center = nothing, position
    if index >= 0.0:
        gap, point, normal, left = closest_to_within(objects, index, met, left)
        center = vec3.add_scaled(point, radius, normal)
        together = any_mesh(objects) or (len(state.contacts) > 1 and any_creases(objects))
        if state.started != 0.0 and together:
            center = met  # others are as near, or the way was not searched to the end: on this one it might be inside
        elif (state.started == 0.0 or gap < radius * (1.0 - INSIDE)) and not is_outside(
            objects, radius, center, center, left
        ):  # the gap is a bound, of a map that was not searched to the end; or another triangle is as near
            if state.started != 0.0:
                center = met
            else:
                center, known = raised(objects, index, radius, center, normal)
                if not known:
                    return Meeting(start, position, nothing, SPENT)
        depth = max(vec3.dot(vec3.sub(center, position), normal), 0.0)
        active = one_constraint(index, normal, depth)
        ended = state.mode != FREE and depth <= INSIDE * radius
        if ended and is_outside(objects, radius, state.center, position, left):
            active, center = nothing, position  # what has just ended, rounded
        else:
            center = rest_of(state.contacts, objects, radius, position, center, active)
    if not any_moves(objects):
        start = center
    # What a mesh was asked on the way is not counted twice: see `BUDGET`.
    left = BUDGET - budget + max(left, 0) if any_creases(objects) else BUDGET
    return Meeting(start, center, active, left)


@jit
def detect_contact(finger: Finger, objects: Any, state: FingerState, probe: Probe, dt: float) -> Approach:
    """A first touch of the only object."""
    zero, against = (0.0, 0.0, 0.0), probe.velocity
    met = detect_among_several(finger, objects, state, probe.position)
    center, active = met.center, met.active
    if active[0].body >= 0.0 and is_hollow(objects[0].shape):
        # The wall may be far along the normal of where it was met. Nothing is wound yet: the nearest place is right.
        center, active, _ = settle_on_one(objects[0], finger.radius, probe.position, center, zero, active[0].normal)
    if met.active[0].body >= 0.0:
        against = relative_velocity(carry_of(objects[0]), probe.velocity, state.probe.position, dt)
    return Approach(
        mode=float(ROLLING),
        cause=float(CAUSE_TOUCH),
        center=center,
        active=active,
        deflection=zero,
        before=zero,
        rolled_part=zero,
        theta=0.0,
        twist=0.0,
        against=against,
        began=True,
        strays=False,
        bounded=0.0,
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
def continue_contact(scene: Scene, finger: Finger, body: Any, state: FingerState, probe: Probe, dt: float) -> Approach:
    """The contact goes with its object and rolls by what the fingertip turned against it."""
    radius, position, last = finger.radius, probe.position, state.contacts[0]
    carried = carry_of(body)
    old_normal, moved = carried_direction(carried, last.normal), carried_point(carried, state.center)
    against = relative_velocity(carried, probe.velocity, state.probe.position, dt)
    turn = relative_rotation(carried, rotations.relative(probe.orientation, state.probe.orientation))
    rolled = roll_on(scene.rolling, body, radius, moved, old_normal, turn)
    begun = OffsetPoint(moved, old_normal)
    whole = rolled.whole
    rolled, beyond, strays = in_hollow(scene.rolling, body, radius, position, begun, turn, rolled)
    center, normal = rolled.center, rolled.normal
    rolled_part = transport(body.shape, carried_direction(carried, last.rolled_part), old_normal, normal)
    before = transport(body.shape, carried_direction(carried, last.deflection), old_normal, normal)
    behind = vec3.sub(center, position)
    active = pressed(normal, behind)
    deflection = vec3.add(vec3.sub(behind, vec3.scale(active[0].depth, normal)), beyond)
    return Approach(
        mode=state.mode,
        cause=float(CAUSE_NONE),
        center=center,
        active=active,
        deflection=deflection,
        before=before,
        rolled_part=vec3.add(rolled_part, rolled.motion),
        theta=rolled.theta,
        twist=rolled.spin,
        against=against,
        began=False,
        strays=strays,
        bounded=0.0 if whole else 1.0,
    )


@jit
def detect_or_continue(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, probe: Probe, dt: float
) -> tuple[FingerState, Approach]:
    """The contact with the only object goes on; where it has ended, what is met in the same tick is another one. The
    state returned is without the contact that has ended."""
    if state.mode != FREE:
        candidate = continue_contact(scene, finger, objects[0], state, probe, dt)
        if not has_ended(candidate.active):
            return state, candidate
    state = separated(state)
    return state, detect_contact(finger, objects, state, probe, dt)


@jit
def has_ended(active: ActiveSet) -> bool:
    """Whether nothing pushes: a probe that has popped through a thin body is outside of it and still active."""
    return not (active[0].depth > 0.0 or active[1].depth > 0.0 or active[2].depth > 0.0)


@jit
def separated(state: FingerState) -> Any:
    """The state without what was wound up in the contact that has ended."""
    return replace(state, "contacts", same_for(state.contacts, NO_CONTACT), "rolled", 0.0, "stuck", 0.0)
