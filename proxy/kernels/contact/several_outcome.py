"""Forces of several contacts at the end of a tick, their sum, and the result reported for each.

Friction is transferred between contacts along with their load shares.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import Approach
from softfinger.proxy.kernels.contact.contact_friction import (
    ContactForces,
    NormalForce,
    compute_load,
    find_ground,
    find_textured_ground,
)
from softfinger.proxy.kernels.contact.fingertip import compute_radius_of_curvature, compute_torque, find_contact_point
from softfinger.proxy.kernels.contact.hand_over import Contacts, find_contact
from softfinger.proxy.kernels.contact.outcome import Outcome
from softfinger.proxy.kernels.contact.prediction import compute_lag
from softfinger.proxy.kernels.contact.rest.several_objects import compute_trailing_force
from softfinger.proxy.kernels.contact.several_rest import Equilibrium
from softfinger.proxy.kernels.effects.forces import NO_FORCE
from softfinger.proxy.kernels.friction.contact_patch import compute_contact_patch, compute_winding_unit
from softfinger.proxy.kernels.friction.laws import rotate_law
from softfinger.proxy.kernels.friction.stick_slip import limit_to_cone
from softfinger.proxy.kernels.friction.torsion import find_spring
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import field_of_each, map_each
from softfinger.proxy.kernels.model import (
    NO_OUTCOME,
    Constraint,
    ContactOutcome,
    ContactState,
    Finger,
    Probe,
    ProbeMotion,
    Vec3,
)
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.record import ON_ITS_WAY, UNSEARCHED


class Share(NamedTuple):
    """Part of one constraint in the wrench.

    pressing    (3,) N    normal force
    tangential  (3,) N    friction
    torque      (3,) N m
    torsion     N m       moment about the normal
    radius      m         of the contact patch
    outcome               ContactOutcome
    """

    pressing: Vec3
    tangential: Vec3
    torque: Vec3
    torsion: float
    radius: float
    outcome: ContactOutcome


NO_SHARE = Share(ZERO, ZERO, ZERO, 0.0, 0.0, NO_OUTCOME)


class FrictionShare(NamedTuple):
    """Friction (3,) N of a constraint, its moment about the normal, N m, and resistance to rolling (3,) N m."""

    force: Vec3
    moment: float
    bending: Vec3


@jit
def compute_load_of_constraint(
    constraint: Constraint, finger: Finger, objects: Any, motion: ProbeMotion, is_new: bool
) -> NormalForce:
    """Return the normal force of a constraint, zero without one."""
    if constraint.object_index < 0.0:
        return NormalForce(0.0, ZERO)
    return compute_load(finger, objects, find_ground(objects, constraint.object_index), constraint, motion, is_new)


@jit
def compute_remaining_share(source: ContactState, after: Contacts) -> float:
    """Return the fraction of its load share that a contact still has after this tick."""
    if source.object_index < 0.0 or source.share <= 0.0:
        return 1.0
    return min(find_contact(source, after).share / source.share, 1.0)


@jit
def add_part_of(
    friction: FrictionShare,
    source: ContactState,
    forces: ContactForces,
    remainder: float,
    gain: float,
    constraint: Constraint,
) -> FrictionShare:
    """Add a part of the friction of the contact `source`, projected onto the tangent plane of a constraint.

    gain  fraction of the lost load shares that the constraint receives
    """
    normal = constraint.normal
    weight = remainder if source.object_index == constraint.object_index else (1.0 - remainder) * gain
    if weight <= 0.0 or source.object_index < 0.0 or source.share <= 0.0:
        return friction
    return FrictionShare(
        vec3.add_scaled(friction.force, weight, vec3.reject(forces.result.force, normal)),
        friction.moment + weight * vec3.dot(source.normal, normal) * forces.result.moment,
        vec3.add_scaled(friction.bending, weight, forces.bending),
    )


@jit
def collect_friction(
    constraint: Constraint, sources: Contacts, forces: Any, remainders: Vec3, lost: float, after: Contacts
) -> FrictionShare:
    """Return the friction of a constraint: the remainder of its contact, and its part of the loss of other contacts.

    The parts follow the load shares as in `hand_over`, so the sum is the force of the spring from probe to proxy.

    sources     predicted contacts
    remainders  fraction of its load share that each of them retains
    lost        sum of the lost shares
    """
    result = FrictionShare(ZERO, 0.0, ZERO)
    if constraint.object_index < 0.0:
        return result
    gain = 0.0
    if lost > 0.0:
        previous = find_contact(constraint, sources)
        gain = max(find_contact(constraint, after).share - previous.share, 0.0) / lost
    result = add_part_of(result, sources[0], forces[0], remainders[0], gain, constraint)
    result = add_part_of(result, sources[1], forces[1], remainders[1], gain, constraint)
    return add_part_of(result, sources[2], forces[2], remainders[2], gain, constraint)


@jit
def compute_wrench_share(
    constraint: Constraint, load: NormalForce, friction: FrictionShare, finger: Finger, objects: Any, probe: Probe,
    settled: Equilibrium, scale: float,
) -> Share:  # fmt: skip
    """Compute the wrench of one constraint; `scale` is the remaining part of the normal force during friction."""
    if constraint.object_index < 0.0:
        return NO_SHARE
    normal = constraint.normal
    ground = find_textured_ground(objects, constraint.object_index, settled.active, settled.center)
    contact = find_contact(constraint, settled.contacts)
    pressing = vec3.scale(load.size, load.direction)
    # The limit of the torsional moment grows by up to f_N^(4/3).
    moment, bending = scale * scale * friction.moment, vec3.scale(scale * scale, friction.bending)
    law = rotate_law(ground.material.friction, ground.orientation)
    tangential = limit_to_cone(law, normal, vec3.scale(scale, friction.force), load.size, contact.slip_speed)
    torque = compute_torque(finger, probe.orientation, normal, moment, pressing, tangential)
    torque = vec3.add(torque, bending)
    curvature_radius = compute_radius_of_curvature(finger, probe.orientation, normal)
    area = compute_contact_patch(finger.patch, curvature_radius, ground.material.compliance, load.size)
    return Share(
        pressing,
        tangential,
        torque,
        moment,
        area.radius,
        ContactOutcome(
            object=ground.scene_index,
            point=find_contact_point(finger, probe.orientation, settled.center, normal),
            normal=normal,
            force=vec3.add(pressing, tangential),
            mode=contact.mode,
            spin=contact.spin / compute_winding_unit(find_spring(ground.material.torsion), area, contact.share),
            torque=torque,
        ),
    )


@jit
def make_outcome_of_several(
    finger: Finger, objects: Any, shapes: Any, motion: ProbeMotion, approach: Approach, forces: Any,
    settled: Equilibrium,
) -> Outcome:  # fmt: skip
    """Sum the wrenches of the contacts, and collect their states."""
    probe, active, is_new = motion.probe, settled.active, approach.is_new
    loads = map_each(compute_load_of_constraint, (active,), finger, objects, motion, is_new)
    load = loads[0].size + loads[1].size + loads[2].size
    friction_load = forces[0].load + forces[1].load + forces[2].load
    scale = load / friction_load if friction_load > load else 1.0
    sources = field_of_each(approach.predicted, "contact")
    remainders = map_each(compute_remaining_share, (sources,), settled.contacts)
    lost = (1.0 - remainders[0]) * sources[0].share + (1.0 - remainders[1]) * sources[1].share
    lost += (1.0 - remainders[2]) * sources[2].share
    friction = map_each(collect_friction, (active,), sources, forces, remainders, lost, settled.contacts)
    shares = map_each(compute_wrench_share, (active, loads, friction), finger, objects, probe, settled, scale)
    one, two, three = shares
    pressing = vec3.add(vec3.add(one.pressing, two.pressing), three.pressing)
    trailing, budget = NO_FORCE, 0.0
    if settled.is_late:
        to_proxy = vec3.sub(settled.center, vec3.add(probe.position, compute_lag(settled.contacts)))
        trailing, budget = compute_trailing_force(shapes, active, to_proxy), float(ON_ITS_WAY)
    if settled.is_late and settled.budget < 0:
        budget = float(UNSEARCHED)
    return Outcome(
        center=settled.center,
        contacts=settled.contacts,
        outcomes=field_of_each(shares, "outcome"),
        pressing=pressing,
        normal_force=vec3.norm(pressing),
        tangential=vec3.add(vec3.add(one.tangential, two.tangential), three.tangential),
        trailing_force=trailing,
        torque=vec3.add(vec3.add(one.torque, two.torque), three.torque),
        torsion=one.torsion,
        radius=one.radius,
        is_late=settled.is_late,
        budget=budget,
    )
