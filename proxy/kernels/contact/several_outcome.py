"""Forces of several contacts at the end of a tick, their sum, and the result reported for each.

Friction is transferred between contacts along with their load shares.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import Approach, stuck_ticks
from softfinger.proxy.kernels.contact.contact_friction import (
    ContactForces,
    NormalForce,
    ProbeMotion,
    ground_at,
    load_on,
    textured_ground_at,
)
from softfinger.proxy.kernels.contact.effects import Effects
from softfinger.proxy.kernels.contact.fingertip import point_under, radius_of_curvature, torque_of
from softfinger.proxy.kernels.contact.hand_over import Contacts, contact_on
from softfinger.proxy.kernels.contact.outcome import Outcome
from softfinger.proxy.kernels.contact.prediction import lag_of
from softfinger.proxy.kernels.contact.rest.several_objects import trailing_force
from softfinger.proxy.kernels.contact.several_rest import Equilibrium
from softfinger.proxy.kernels.friction.contact_patch import contact_patch, winding_unit
from softfinger.proxy.kernels.friction.laws import rotate_law
from softfinger.proxy.kernels.friction.stick_slip import limit_to_cone
from softfinger.proxy.kernels.friction.torsion import spring_of
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import field_of_each, map_each
from softfinger.proxy.kernels.model import (
    NO_OUTCOME,
    Constraint,
    ContactOutcome,
    ContactState,
    Finger,
    Probe,
    Smooth,
    Vec3,
)
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.objects import number_of
from softfinger.proxy.record import CAUSE_NONE, CAUSE_TOUCH, ON_ITS_WAY, UNSEARCHED


class Share(NamedTuple):
    """Part of one constraint in the wrench.

    pressing    (3,) N    normal force
    tangential  (3,) N    friction
    torque      (3,) N m
    torsion     N m       moment about the normal
    radius      m         of the contact patch
    reported              ContactOutcome
    """

    pressing: Vec3
    tangential: Vec3
    torque: Vec3
    torsion: float
    radius: float
    reported: ContactOutcome


NO_SHARE = Share(ZERO, ZERO, ZERO, 0.0, 0.0, NO_OUTCOME)


class FrictionShare(NamedTuple):
    """Friction (3,) N of a constraint, its moment about the normal, N m, and resistance to rolling (3,) N m."""

    force: Vec3
    moment: float
    bending: Vec3


@jit
def load_of(constraint: Constraint, finger: Finger, objects: Any, motion: ProbeMotion, touches: bool) -> NormalForce:
    """Return the normal force of a constraint, zero without one."""
    if constraint.body < 0.0:
        return NormalForce(0.0, ZERO)
    return load_on(finger, objects, ground_at(objects, constraint.body), constraint, motion, touches)


@jit
def remaining_share(giver: ContactState, after: Contacts) -> float:
    """Return the fraction of its load share that a contact still has after this tick."""
    if giver.body < 0.0 or giver.share <= 0.0:
        return 1.0
    return min(contact_on(giver, after).share / giver.share, 1.0)


@jit
def add_part_of(
    friction: FrictionShare,
    giver: ContactState,
    forces: ContactForces,
    remainder: float,
    gain: float,
    constraint: Constraint,
) -> FrictionShare:
    """Add a part of the friction of the contact `giver`, projected onto the tangent plane of a constraint.

    gain  fraction of the lost load shares that the constraint receives
    """
    normal = constraint.normal
    weight = remainder if giver.body == constraint.body else (1.0 - remainder) * gain
    if weight <= 0.0 or giver.body < 0.0 or giver.share <= 0.0:
        return friction
    return FrictionShare(
        vec3.add_scaled(friction.force, weight, vec3.reject(forces.result.force, normal)),
        friction.moment + weight * vec3.dot(giver.normal, normal) * forces.result.moment,
        vec3.add_scaled(friction.bending, weight, forces.bending),
    )


@jit
def friction_share_on(
    constraint: Constraint, givers: Contacts, forces: Any, remainders: Vec3, lost: float, after: Contacts
) -> FrictionShare:
    """Return the friction of a constraint: the remainder of its contact, and its part of the loss of other contacts.

    The parts follow the load shares as in `hand_over`, so the sum is the force of the spring from probe to proxy.

    givers      predicted contacts
    remainders  fraction of its load share that each of them retains
    lost        sum of the lost shares
    """
    result = FrictionShare(ZERO, 0.0, ZERO)
    if constraint.body < 0.0:
        return result
    gain = 0.0
    if lost > 0.0:
        previous = contact_on(constraint, givers)
        gain = max(contact_on(constraint, after).share - previous.share, 0.0) / lost
    result = add_part_of(result, givers[0], forces[0], remainders[0], gain, constraint)
    result = add_part_of(result, givers[1], forces[1], remainders[1], gain, constraint)
    return add_part_of(result, givers[2], forces[2], remainders[2], gain, constraint)


@jit
def share_of_wrench(
    constraint: Constraint, load: NormalForce, friction: FrictionShare, finger: Finger, objects: Any, probe: Probe,
    settled: Equilibrium, scale: float,
) -> Share:  # fmt: skip
    """Compute the wrench of one constraint; `scale` is the remaining part of the normal force during friction."""
    if constraint.body < 0.0:
        return NO_SHARE
    normal = constraint.normal
    ground = textured_ground_at(objects, constraint.body, settled.active, settled.center)
    contact = contact_on(constraint, settled.contacts)
    pressing = vec3.scale(load.size, load.along)
    # The limit of the torsional moment grows by up to f_N^(4/3).
    moment, bending = scale * scale * friction.moment, vec3.scale(scale * scale, friction.bending)
    law = rotate_law(ground.material.friction, ground.orientation)
    tangential = limit_to_cone(law, normal, vec3.scale(scale, friction.force), load.size, contact.slip_speed)
    torque = torque_of(finger.form, finger.radius, probe.orientation, normal, moment, pressing, tangential)
    torque = vec3.add(torque, bending)
    curvature_radius = radius_of_curvature(finger.form, finger.radius, probe.orientation, normal)
    area = contact_patch(finger.patch, curvature_radius, ground.material.compliance, load.size)
    return Share(
        pressing,
        tangential,
        torque,
        moment,
        area.radius,
        ContactOutcome(
            object=ground.number,
            point=point_under(finger.form, finger.radius, probe.orientation, settled.center, normal),
            normal=normal,
            force=vec3.add(pressing, tangential),
            mode=contact.mode,
            spin=contact.spin / winding_unit(spring_of(ground.material.torsion), area, contact.share),
            torque=torque,
        ),
    )


@jit
def outcome_of_several(
    finger: Finger, objects: Any, shapes: Any, motion: ProbeMotion, approach: Approach, forces: Any,
    settled: Equilibrium, effects: Effects,
) -> Outcome:  # fmt: skip
    """Sum the wrenches of the contacts, and collect their states."""
    probe, active, began = motion.probe, settled.active, approach.began
    loads = map_each(load_of, (active,), finger, objects, motion, began)
    load = loads[0].size + loads[1].size + loads[2].size
    friction_load = forces[0].load + forces[1].load + forces[2].load
    scale = load / friction_load if friction_load > load else 1.0
    givers = field_of_each(approach.predicted, "contact")
    remainders = map_each(remaining_share, (givers,), settled.contacts)
    lost = (1.0 - remainders[0]) * givers[0].share + (1.0 - remainders[1]) * givers[1].share
    lost += (1.0 - remainders[2]) * givers[2].share
    friction = map_each(friction_share_on, (active,), givers, forces, remainders, lost, settled.contacts)
    shares = map_each(share_of_wrench, (active, loads, friction), finger, objects, probe, settled, scale)
    one, two, three = shares
    pressing = vec3.add(vec3.add(one.pressing, two.pressing), three.pressing)
    extra, budget = effects.force, 0.0
    if settled.late and not isinstance(shapes.search, Smooth):
        to_proxy = vec3.sub(settled.center, vec3.add(probe.position, lag_of(settled.contacts)))
        extra, budget = vec3.add(extra, trailing_force(shapes, active, to_proxy)), float(ON_ITS_WAY)
    if effects.unknown != 0.0 or (settled.late and settled.budget < 0):
        budget = float(UNSEARCHED)
    cause, stuck = forces[0].result.cause, 0.0
    if began and cause == CAUSE_NONE:
        cause = float(CAUSE_TOUCH)
    if settled.late:
        stuck = stuck_ticks(approach, settled.center)
    return Outcome(
        mode=settled.contacts[0].mode,
        cause=cause,
        object=number_of(shapes, active[0].body),
        normal=active[0].normal,
        center=settled.center,
        contacts=settled.contacts,
        reported=field_of_each(shares, "reported"),
        pressing=pressing,
        normal_force=vec3.norm(pressing),
        tangential=vec3.add(vec3.add(one.tangential, two.tangential), three.tangential),
        effects=extra,
        effect_states=effects.states,
        torque=vec3.add(vec3.add(one.torque, two.torque), three.torque),
        torsion=one.torsion,
        spin=one.reported.spin,
        radius=one.radius,
        rolled=approach.rolled,
        stuck=stuck,
        budget=budget,
    )
