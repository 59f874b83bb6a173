"""A tick of a finger that several objects may touch.

Friction comes first, of each contact by itself. Then the proxy follows to where the objects let it rest, and
deflections go over from the contacts that bear less to those that bear more. A finger that one object touches, and
stays clear of all others, is in contact as if there were no others.
"""

from typing import Any, NamedTuple

from numba import literal_unroll

from softfinger.proxy.kernels.contact.carry import any_moves
from softfinger.proxy.kernels.contact.contact_friction import (
    ContactForces,
    Prediction,
    ProbeMotion,
    after_friction,
    apply_friction,
    ground_at,
)
from softfinger.proxy.kernels.contact.detection import (
    NO_PREDICTION,
    Approach,
    continue_contact,
    detect_contact,
    has_ended,
    separated,
)
from softfinger.proxy.kernels.contact.hand_over import Contacts, hand_over
from softfinger.proxy.kernels.contact.one_contact import Landing
from softfinger.proxy.kernels.contact.prediction import continue_several, lag_of
from softfinger.proxy.kernels.contact.rest.active_set import INSIDE, active_objects, leaves_no_room, one_constraint
from softfinger.proxy.kernels.contact.rest.alone import settle_on_one
from softfinger.proxy.kernels.contact.rest.among import (
    is_a_step,
    over_edges,
    settle_among_several,
    slide_over_facets,
)
from softfinger.proxy.kernels.contact.rest.cutting_planes import AT_REST, pushed_at
from softfinger.proxy.kernels.contact.texture import with_texture_friction
from softfinger.proxy.kernels.friction.contact_patch import ContactPatch
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NONE,
    ActiveSet,
    Constraint,
    ContactState,
    Finger,
    FingerState,
    FrictionResult,
    Probe,
    Scene,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.elements import contains, count, element
from softfinger.proxy.kernels.query.kinds import (
    SINGLE_POINT,
    WITH_HEIGHTMAP,
    WITH_MESH,
    by_multipoint,
    has_creases_at,
    is_mesh_at,
    kind_at,
)
from softfinger.proxy.kernels.query.objects import deepest
from softfinger.proxy.kernels.query.sweep import first_hit
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.record import CAUSE_NONE, FREE, SLIDING

ZERO: Vec3 = (0.0, 0.0, 0.0)
NO_FORCES = ContactForces(
    result=FrictionResult(
        mode=float(FREE), cause=float(CAUSE_NONE), deflection=ZERO, rolled_part=ZERO, slip_speed=0.0,
        slip_deflection=0.0, spin=0.0, spin_slip_speed=0.0, spin_slip_angle=0.0, force=ZERO, moment=0.0,
    ),
    area=ContactPatch(radius=0.0, torsional=0.0, lever=0.0, bending=0.0, bend_max=0.0),
    unit=1.0, load=0.0, bend=ZERO, bending=ZERO,
)  # fmt: skip
"""Forces where there is no contact."""
DEEP = 0.5
"""Depth, as a share of the fingertip's radius, to which a probe is raised while the proxy comes to rest: half the
smallest radius of curvature of what it moves on, that of an edge."""


class Settled(NamedTuple):
    """The proxy (3,) m at the end of a tick, its constraints and contacts, whether it has yet to come to rest, and
    what is left of the budget, below 0 if it was used up."""

    center: Vec3
    active: ActiveSet
    contacts: Contacts
    late: bool
    budget: int


@jit
def is_single(state: FingerState, radius: float) -> bool:
    """Whether one object holds the proxy, at rest: displaced from the probe by its push and its deflection alone."""
    one, two, _ = state.contacts
    if two.body >= 0.0:
        return False
    behind = vec3.sub(vec3.sub(state.center, state.probe.position), one.deflection)
    beside = vec3.add_scaled(behind, -one.push, one.normal)
    return vec3.dot(beside, beside) <= (10.0 * AT_REST * radius) ** 2


@jit
def nothing_approached(probe: Probe) -> Approach:
    """An Approach without a contact."""
    return Approach(
        start=probe.position, outside=probe.position, center=probe.position,
        active=one_constraint(NONE, (0.0, 0.0, 1.0), 0.0), predicted=(NO_PREDICTION, NO_PREDICTION, NO_PREDICTION),
        rolled=0.0, strays=False, single=True, began=False, bounded=0.0, budget=BUDGET, stuck=0.0,
    )  # fmt: skip


@jit
def continue_single(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, probe: Probe, dt: float
) -> Approach:
    """The only contact of the last tick goes on, with the object of several that it is on."""
    index, found, at = state.contacts[0].body, nothing_approached(probe), 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            found = continue_contact(scene, finger, element(entry, index - at), index, state, probe, dt)
        at += count(entry)
    return found


@jit
def is_clear_of_others(
    objects: Any, radius: float, start: Vec3, center: Vec3, index: float, budget: int, room: float
) -> bool:
    """Whether the proxy meets nothing on its way from `start` to `center` (3,) m but the object with that place.

    room  1 if what it only touches counts too, as the next of two flush objects, else -1
    """
    held = (index, -1.0, -1.0)
    if start != center or any_moves(objects):
        hit, _, budget = first_hit(objects, start, center, radius, True, held, budget)
        if hit >= 0.0:
            return False
    gap, at, budget = deepest(objects, center, radius * (1.0 + INSIDE), held, budget)
    # The proxy may cut into its own triangles, and into a height map that was not searched to the end.
    rests_on_it = at == index and kind_at(objects, index) == 0.0
    return budget >= 0 and (gap >= radius * (1.0 + room * INSIDE) or rests_on_it)


@jit
def rolls_clear_of_others(objects: Any, radius: float, approach: Approach) -> bool:
    """Whether the only contact rolls over nothing but its own object: past a seam the next one is what it rolls on."""
    if approach.center == approach.outside:
        return True
    index = approach.active[0].body
    # Facets that share an edge are touched together on it, and are one surface.
    room = -1.0 if is_mesh_at(objects, index) else 1.0
    return is_clear_of_others(objects, radius, approach.center, approach.center, index, approach.budget, room)


@jit
def approach_among_several(
    scene: Scene, finger: Finger, objects: Any, shapes: Any, state: FingerState, motion: ProbeMotion
) -> tuple[FingerState, Approach]:
    """The contacts go on; if they have ended, what is met in the same tick is another one. The state returned is
    without contacts that have ended."""
    if state.mode != FREE:
        single = is_single(state, finger.radius)
        approach = nothing_approached(motion.probe)
        if single:
            approach = continue_single(scene, finger, shapes, state, motion.probe, motion.dt)
            single = rolls_clear_of_others(shapes, finger.radius, approach)
        if not single:
            approach = continue_several(scene, objects, shapes, finger.radius, state, motion)
        if not has_ended(approach.active):
            return state, approach
    state = separated(state)
    return state, detect_contact(finger, shapes, state, motion.probe)


@jit
def rub(finger: Finger, objects: Any, predicted: Prediction, motion: ProbeMotion) -> ContactForces:
    """Friction of one of several contacts."""
    contact = predicted.contact
    if contact.body < 0.0 or contact.share <= 0.0:
        return NO_FORCES
    return apply_friction(finger, objects, ground_at(objects, contact.body), predicted, contact.share, motion)


@jit
def rub_each(
    finger: Finger, objects: Any, approach: Approach, motion: ProbeMotion
) -> tuple[ContactForces, ContactForces, ContactForces]:
    """Friction of each contact."""
    rough = with_texture_friction(objects, approach.active, approach.center)
    one, two, three = approach.predicted
    return rub(finger, rough, one, motion), rub(finger, rough, two, motion), rub(finger, rough, three, motion)


@by_multipoint
def follow_slip(
    objects: Any, index: float, radius: float, position: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> Any:
    """`settle_on_one`, over the edges of facets too; and whether the proxy has come to rest."""


@follow_slip.of(SINGLE_POINT, WITH_HEIGHTMAP)
def follow_slip_on_shape(
    objects: Any, index: float, radius: float, position: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, float, bool]:
    center, active, bounded = settle_on_one(objects, index, radius, position, center, deflection, normal)
    return center, active, bounded, True


@follow_slip.of(WITH_MESH)
def follow_slip_on_mesh(
    objects: Any, index: float, radius: float, position: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, float, bool]:
    bounded, at_rest = 0.0, True
    if is_mesh_at(objects, index):
        center, active, at_rest = slide_over_facets(objects, index, radius, position, center, deflection, normal)
    else:
        center, active, bounded = settle_on_one(objects, index, radius, position, center, deflection, normal)
    return center, active, bounded, at_rest


@jit
def land_in_company(
    finger: Finger, objects: Any, approach: Approach, forces: ContactForces, position: Vec3
) -> tuple[Landing, bool]:
    """The only contact's proxy after friction, and whether it stays clear of all other objects."""
    center, active, bounded, at_rest = approach.center, approach.active, 0.0, True
    held, radius, kept = active[0], finger.radius, forces.result
    if not approach.single:
        return Landing(center, active, bounded), False
    if kept.mode == SLIDING or kept.deflection != approach.predicted[0].deflection or approach.strays:
        center, active, bounded, at_rest = follow_slip(
            objects, held.body, radius, position, center, kept.deflection, held.normal
        )
    if not at_rest or (is_mesh_at(objects, held.body) and not is_a_step(approach.outside, center, radius)):
        return Landing(center, active, bounded), False
    # A first touch may be over the next of two flush objects, beyond the edge of the one that was met.
    room = 1.0 if approach.began else -1.0
    clear = is_clear_of_others(objects, radius, approach.start, center, active[0].body, approach.budget, room)
    return Landing(center, active, bounded), clear


@jit
def rubbed(predicted: Prediction, forces: ContactForces) -> ContactState:
    """A contact after friction, or none if it bears nothing."""
    nothing = predicted.contact.body < 0.0 or predicted.contact.share <= 0.0
    return NO_CONTACT if nothing else after_friction(predicted, forces)


@jit
def taken_along(contact: ContactState, constraint: Constraint) -> ContactState:
    """A contact that the proxy has taken along over its object."""
    if contact.body < 0.0:
        return contact
    n = constraint.normal
    deflection, rolled_part = vec3.reject(contact.deflection, n), vec3.reject(contact.rolled_part, n)
    return replace(contact, "normal", n, "push", constraint.depth, "deflection", deflection, "rolled_part", rolled_part)


@jit
def pressed_again(contacts: Contacts, active: ActiveSet) -> Contacts:
    """Contacts at the constraints of a proxy that has moved."""
    one, two, three = contacts
    return taken_along(one, active[0]), taken_along(two, active[1]), taken_along(three, active[2])


@jit
def eased(active: ActiveSet, ease: float) -> ActiveSet:
    """Constraints that push a part of what they do."""
    one, two, three = active
    return (
        Constraint(one.body, one.normal, ease * one.depth),
        Constraint(two.body, two.normal, ease * two.depth),
        Constraint(three.body, three.normal, ease * three.depth),
    )


@jit
def lag_predicted(approach: Approach) -> Vec3:
    """Mean deflection (3,) m of the contacts if all stick."""
    one, two, three = approach.predicted
    lag = vec3.scale(one.contact.share, one.deflection)
    return vec3.add_scaled(
        vec3.add_scaled(lag, two.contact.share, two.deflection), three.contact.share, three.deflection
    )


@jit
def drawn_aside(contact: ContactState, way: Vec3) -> ContactState:
    """A contact whose deflection is longer by what of `way` (3,) m lies in its tangent plane."""
    if contact.body < 0.0:
        return contact
    return replace(contact, "deflection", vec3.add(contact.deflection, vec3.reject(way, contact.normal)))


@jit
def settle_after_friction(
    finger: Finger, objects: Any, shapes: Any, approach: Approach, forces: Any, position: Vec3
) -> Settled:
    """The proxy follows to the place nearest to the displaced probe, and contacts change to what holds it there.

    Below the centre of curvature of what holds the proxy that place is not stable: a contact that sticks would swing
    round its object. So a probe that is deeper than `DEEP` is raised to there, towards where the proxy is if all stick.
    """
    after = (
        rubbed(approach.predicted[0], forces[0]),
        rubbed(approach.predicted[1], forces[1]),
        rubbed(approach.predicted[2], forces[2]),
    )
    radius, lag, budget = finger.radius, lag_of(after), approach.budget
    goal, active, ease = vec3.add(position, lag), approach.active, 1.0
    above = vec3.sub(approach.center, vec3.add(position, lag_predicted(approach)))
    depth = vec3.norm(above)
    if lag != ZERO and depth > DEEP * radius:
        ease = DEEP * radius / depth
        goal, active = vec3.add_scaled(goal, 1.0 - ease, above), eased(active, ease)
    if approach.single and has_creases_at(shapes, approach.active[0].body):
        budget = budget // 4  # a height map has been asked as the only object
    rest = settle_among_several(shapes, radius, goal, approach.start, approach.outside, active, budget)
    active = over_edges(shapes, rest.active, rest.center)
    if active_objects(active) == (after[0].body, after[1].body, after[2].body):
        contacts = pressed_again(after, active)
    else:
        contacts = pressed_again(hand_over(objects, after, active), active)
    displaced = vec3.add(position, lag_of(contacts))
    if displaced != goal:
        active, place = pushed_at(shapes, radius, displaced, rest.center, active)
        contacts = pressed_again(contacts, active)
        if ease < 1.0 and not rest.late and not leaves_no_room(active):
            one, two, three = contacts
            aside = vec3.sub(rest.center, place)
            contacts = drawn_aside(one, aside), drawn_aside(two, aside), drawn_aside(three, aside)
    return Settled(rest.center, active, contacts, rest.late, rest.budget)
