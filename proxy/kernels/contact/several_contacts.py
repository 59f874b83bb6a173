"""A tick of a finger that several objects may touch.

Friction comes first, of each contact by itself. Then the proxy follows to where the objects let it rest, and
deflections go over from the contacts that bear less to those that bear more. A finger that one object touches, and
stays clear of all others, is in contact as if there were no others.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import any_moves
from softfinger.proxy.kernels.contact.contact_friction import (
    ContactForces,
    Prediction,
    ProbeMotion,
    after_friction,
    apply_friction,
    ground_at,
    load_on,
    rough_ground_at,
)
from softfinger.proxy.kernels.contact.detection import (
    NO_PREDICTION,
    Approach,
    continue_contact,
    detect_contact,
    has_ended,
    separated,
)
from softfinger.proxy.kernels.contact.effects import Effects
from softfinger.proxy.kernels.contact.fingertip import point_under, radius_of_curvature, torque_of
from softfinger.proxy.kernels.contact.hand_over import Contacts, contact_on, hand_over
from softfinger.proxy.kernels.contact.one_contact import Landing, slips
from softfinger.proxy.kernels.contact.outcome import Outcome
from softfinger.proxy.kernels.contact.prediction import continue_several, lag_of
from softfinger.proxy.kernels.contact.rest.active_set import INSIDE, active_objects, one_constraint
from softfinger.proxy.kernels.contact.rest.alone import settle_on_one
from softfinger.proxy.kernels.contact.rest.among import (
    drawn_after,
    is_a_step,
    over_edges,
    settle_among_several,
    slide_over_facets,
)
from softfinger.proxy.kernels.contact.rest.cutting_planes import AT_REST, pushed_at
from softfinger.proxy.kernels.friction.contact_patch import ContactPatch, contact_patch, winding_unit
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NO_OUTCOME,
    NONE,
    ActiveSet,
    Constraint,
    ContactOutcome,
    ContactState,
    Finger,
    FingerState,
    FrictionResult,
    Probe,
    Scene,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.query.kinds import any_multipoint, has_creases_at, is_mesh_at, kind_at
from softfinger.proxy.kernels.query.objects import deepest, number_of
from softfinger.proxy.kernels.query.sweep import first_hit
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.record import CAUSE_NONE, CAUSE_TOUCH, FREE, ON_ITS_WAY, UNSEARCHED

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
    index = state.contacts[0].body
    return continue_contact(scene, finger, object_at(objects, index), index, state, probe, dt)


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
    return is_clear_of_others(
        objects, radius, approach.center, approach.center, approach.active[0].body, approach.budget, -1.0
    )


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
def rub(finger: Finger, objects: Any, approach: Approach, predicted: Prediction, motion: ProbeMotion) -> ContactForces:
    """Friction of one of several contacts."""
    contact = predicted.contact
    if contact.body < 0.0 or contact.share <= 0.0:
        return NO_FORCES
    ground = rough_ground_at(objects, contact.body, approach.active, approach.center)
    return apply_friction(finger, objects, ground, predicted, contact.share, motion)


@jit
def rub_each(
    finger: Finger, objects: Any, approach: Approach, motion: ProbeMotion
) -> tuple[ContactForces, ContactForces, ContactForces]:
    """Friction of each contact."""
    one, two, three = approach.predicted
    return (
        rub(finger, objects, approach, one, motion),
        rub(finger, objects, approach, two, motion),
        rub(finger, objects, approach, three, motion),
    )


@jit
def land_in_company(
    finger: Finger, objects: Any, approach: Approach, forces: ContactForces, position: Vec3
) -> tuple[Landing, bool]:
    """The only contact's proxy after friction, and whether it stays clear of all other objects."""
    center, active, bounded, radius = approach.center, approach.active, 0.0, finger.radius
    index = active[0].body
    if not approach.single:
        return Landing(center, active, bounded), False
    deflection, normal = forces.result.deflection, active[0].normal
    if is_mesh_at(objects, index):
        at_rest = True
        if slips(approach, forces):
            center, active, at_rest = slide_over_facets(objects, index, radius, position, center, deflection, normal)
        if not (at_rest and is_a_step(approach.outside, center, radius)):
            return Landing(center, active, bounded), False
    elif slips(approach, forces):
        center, active, bounded = settle_on_one(objects, index, radius, position, center, deflection, normal)
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
def settle_after_friction(
    finger: Finger, objects: Any, shapes: Any, approach: Approach, forces: Any, position: Vec3
) -> Settled:
    """The proxy follows to the place nearest to the displaced probe, and contacts change to what holds it there."""
    after = (
        rubbed(approach.predicted[0], forces[0]),
        rubbed(approach.predicted[1], forces[1]),
        rubbed(approach.predicted[2], forces[2]),
    )
    goal, budget = vec3.add(position, lag_of(after)), approach.budget
    if approach.single and has_creases_at(shapes, approach.active[0].body):
        budget = budget // 4  # a height map has been asked as the only object
    rest = settle_among_several(shapes, finger.radius, goal, approach.start, approach.outside, approach.active, budget)
    active = over_edges(shapes, rest.active, rest.center)
    if active_objects(active) == (after[0].body, after[1].body, after[2].body):
        one, two, three = after
    else:
        one, two, three = hand_over(objects, after, active)
    contacts = pressed_again((one, two, three), active)
    displaced = vec3.add(position, lag_of(contacts))
    if displaced != goal:
        active = pushed_at(shapes, finger.radius, displaced, rest.center, active)
        contacts = pressed_again(contacts, active)
    return Settled(rest.center, active, contacts, rest.late, rest.budget)


# --- outcome -----------------------------------------------------------------------------------------


class Share(NamedTuple):
    """Part of one constraint in the wrench: normal force, friction (3,) N, torque (3,) N m, and its report."""

    pressing: Vec3
    tangential: Vec3
    torque: Vec3
    reported: ContactOutcome


NO_SHARE = Share(ZERO, ZERO, ZERO, NO_OUTCOME)


@jit
def load_of(finger: Finger, objects: Any, constraint: Constraint, motion: ProbeMotion, touches: bool) -> float:
    """Normal force of a constraint, N, 0 of none."""
    if constraint.body < 0.0:
        return 0.0
    return load_on(finger, objects, ground_at(objects, constraint.body), constraint, motion, touches).size


@jit
def sum_of_loads(forces: Any) -> float:
    """Normal forces of all contacts during friction, N."""
    return forces[0].load + forces[1].load + forces[2].load


@jit
def forces_on(approach: Approach, forces: Any, body: float) -> ContactForces:
    """Forces of the contact on that object, or none."""
    one, two, three = approach.predicted
    if body >= 0.0:
        if one.contact.body == body:
            return forces[0]
        if two.contact.body == body:
            return forces[1]
        if three.contact.body == body:
            return forces[2]
    return NO_FORCES


@jit
def friction_of(
    finger: Finger, probe: Probe, normal: Vec3, forces: ContactForces, ease: float, pressing: Vec3
) -> tuple[Vec3, Vec3]:
    """Friction (3,) N of a contact under that normal, eased as the load is, and the torque of it and of `pressing`."""
    tangential = vec3.scale(ease, vec3.reject(forces.result.force, normal))
    moment = ease * ease * forces.result.moment
    torque = torque_of(finger.form, finger.radius, probe.orientation, normal, moment, pressing, tangential)
    return tangential, vec3.add_scaled(torque, ease * ease, forces.bending)


@jit
def share_of_wrench(
    finger: Finger, objects: Any, motion: ProbeMotion, approach: Approach, forces: Any, settled: Settled,
    constraint: Constraint, ease: float,
) -> Share:  # fmt: skip
    """Wrench of one constraint; `ease` is the share of the normal force during friction that is left."""
    if constraint.body < 0.0:
        return NO_SHARE
    probe, ground = motion.probe, ground_at(objects, constraint.body)
    contact = contact_on(settled.contacts, constraint.body)
    load = load_on(finger, objects, ground, constraint, motion, approach.began)
    pressing = vec3.scale(load.size, load.along)
    own = forces_on(approach, forces, constraint.body)
    tangential, torque = friction_of(finger, probe, constraint.normal, own, ease, pressing)
    round_by = radius_of_curvature(finger.form, finger.radius, probe.orientation, constraint.normal)
    area = contact_patch(finger.patch, round_by, ground.material.compliance, load.size)
    return Share(
        pressing,
        tangential,
        torque,
        ContactOutcome(
            object=ground.number,
            point=point_under(finger.form, finger.radius, probe.orientation, settled.center, constraint.normal),
            normal=constraint.normal,
            force=vec3.add(pressing, tangential),
            mode=contact.mode,
            spin=contact.spin / winding_unit(ground.material.torsion, area, contact.share),
            torque=torque,
        ),
    )


@jit
def left_behind(
    finger: Finger, probe: Probe, settled: Settled, predicted: Prediction, forces: ContactForces, ease: float
) -> tuple[Vec3, Vec3]:
    """Friction (3,) N and torque (3,) N m of a contact whose object no longer holds the proxy: what it held passes to
    the others in this tick."""
    contact = predicted.contact
    if contact.body < 0.0 or contact.share <= 0.0 or contact_on(settled.contacts, contact.body).body >= 0.0:
        return ZERO, ZERO
    return friction_of(finger, probe, settled.active[0].normal, forces, ease, ZERO)


@jit
def outcome_of_several(
    finger: Finger, objects: Any, shapes: Any, motion: ProbeMotion, approach: Approach, forces: Any, settled: Settled,
    effects: Effects,
) -> Outcome:  # fmt: skip
    """The sum of the contacts' wrenches, and their states."""
    probe, active, began = motion.probe, settled.active, approach.began
    load = load_of(finger, objects, active[0], motion, began) + load_of(finger, objects, active[1], motion, began)
    load, before = load + load_of(finger, objects, active[2], motion, began), sum_of_loads(forces)
    ease = load / before if before > load else 1.0
    one = share_of_wrench(finger, objects, motion, approach, forces, settled, active[0], ease)
    two = share_of_wrench(finger, objects, motion, approach, forces, settled, active[1], ease)
    three = share_of_wrench(finger, objects, motion, approach, forces, settled, active[2], ease)
    rest1, turn1 = left_behind(finger, probe, settled, approach.predicted[0], forces[0], ease)
    rest2, turn2 = left_behind(finger, probe, settled, approach.predicted[1], forces[1], ease)
    rest3, turn3 = left_behind(finger, probe, settled, approach.predicted[2], forces[2], ease)
    passed, turned = vec3.add(vec3.add(rest1, rest2), rest3), vec3.add(vec3.add(turn1, turn2), turn3)
    reported = replace(
        one.reported, "force", vec3.add(one.reported.force, passed), "torque", vec3.add(one.reported.torque, turned)
    )
    pressing = vec3.add(vec3.add(one.pressing, two.pressing), three.pressing)
    tangential = vec3.add(vec3.add(vec3.add(one.tangential, two.tangential), three.tangential), passed)
    first, extra, budget = forces[0], effects.force, 0.0
    on_its_way = settled.late and any_multipoint(shapes)
    if on_its_way:
        behind = vec3.sub(settled.center, vec3.add(probe.position, lag_of(settled.contacts)))
        extra, budget = vec3.add(extra, drawn_after(shapes, active, behind)), float(ON_ITS_WAY)
    if effects.unknown != 0.0 or (settled.late and settled.budget < 0):
        budget = float(UNSEARCHED)
    cause, stuck = first.result.cause, 0.0
    if began and cause == CAUSE_NONE:
        cause = float(CAUSE_TOUCH)
    if settled.late and settled.center == approach.outside:
        stuck = approach.stuck + 1.0
    return Outcome(
        mode=settled.contacts[0].mode,
        cause=cause,
        object=number_of(shapes, active[0].body),
        normal=active[0].normal,
        center=settled.center,
        contacts=settled.contacts,
        reported=(reported, two.reported, three.reported),
        pressing=pressing,
        normal_force=vec3.norm(pressing),
        tangential=tangential,
        effects=extra,
        effect_states=effects.states,
        torque=vec3.add(vec3.add(vec3.add(one.torque, two.torque), three.torque), turned),
        torsion=ease * ease * first.result.moment,
        spin=one.reported.spin,
        radius=first.area.radius,
        rolled=approach.rolled,
        stuck=stuck,
        budget=budget,
    )
