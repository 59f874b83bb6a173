"""Friction and result of a contact with one object: the only one of a scene, or the only one touched."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import Approach
from softfinger.proxy.kernels.contact.contact_friction import ContactForces, Ground, NormalForce, with_friction_result
from softfinger.proxy.kernels.contact.fingertip import compute_torque, find_contact_point
from softfinger.proxy.kernels.contact.outcome import Outcome
from softfinger.proxy.kernels.contact.rest.one_object import settle_on_one
from softfinger.proxy.kernels.effects.forces import NO_FORCE
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of, replace
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NO_OUTCOME,
    ActiveSet,
    ContactOutcome,
    ContactState,
    Finger,
    Probe,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.record import SLIDING


class Landing(NamedTuple):
    """Position of the proxy after friction.

    center            (3,) m
    active                   constraints at `center`
    budget_exhausted         1 if the search budget was exhausted, otherwise 0
    """

    center: Vec3
    active: ActiveSet
    budget_exhausted: float


@jit
def does_move(approach: Approach, forces: ContactForces) -> bool:
    """Return True if friction moves the proxy of a single contact: by a slip, or by a roll not yet in its position."""
    friction = forces.result
    return (
        friction.mode == SLIDING
        or friction.deflection != approach.predicted[0].deflection
        or approach.center_lacks_roll
    )


@jit
def land_on_one(finger: Finger, shapes: Any, approach: Approach, forces: ContactForces, position: Vec3) -> Landing:
    """Move the proxy with a slip over the only object; it does not move if it sticks."""
    constraint = approach.active[0]
    if not does_move(approach, forces):
        return Landing(approach.center, approach.active, 0.0)
    center, active, budget_exhausted = settle_on_one(
        shapes,
        constraint.object_index,
        finger.radius,
        position,
        approach.center,
        forces.result.deflection,
        constraint.normal,
    )
    return Landing(center, active, budget_exhausted)


@jit
def make_contact_state(landing: Landing, predicted: Any, forces: ContactForces, position: Vec3) -> ContactState:
    """Return the contact at the end of the tick; its deflection is the tangential part from probe to proxy."""
    constraint = landing.active[0]
    to_proxy = vec3.sub(landing.center, position)
    return replace(
        with_friction_result(predicted, forces),
        "object_index", constraint.object_index, "normal", constraint.normal, "push", constraint.depth,
        "deflection", vec3.sub(to_proxy, vec3.scale(constraint.depth, constraint.normal)),
        "rolled_part", vec3.reject(forces.result.rolled_part, constraint.normal),
    )  # fmt: skip


@jit
def make_outcome_of_one(
    finger: Finger,
    ground: Ground,
    probe: Probe,
    approach: Approach,
    forces: ContactForces,
    landing: Landing,
    load: NormalForce,
) -> Outcome:
    """Compute the forces of the only contact under `load` at its new position, and its state."""
    friction, normal = forces.result, landing.active[0].normal
    tangential, moment, bending = vec3.reject(friction.force, normal), friction.moment, forces.bending
    if forces.load > load.size:
        # The normal force is smaller there. Scaling leaves both within their limits; the torsional one grows by up to
        # f_N^(4/3).
        ease = load.size / forces.load
        tangential, moment = vec3.scale(ease, tangential), ease * ease * moment
        bending = vec3.scale(ease * ease, bending)
    pressing = vec3.scale(load.size, load.direction)
    torque = compute_torque(finger, probe.orientation, normal, moment, pressing, tangential)
    torque = vec3.add(torque, bending)
    outcome = ContactOutcome(
        object=ground.scene_index,
        point=find_contact_point(finger, probe.orientation, landing.center, normal),
        normal=normal,
        force=vec3.add(pressing, tangential),
        mode=friction.mode,
        spin=friction.spin,
        torque=torque,
    )
    contact = make_contact_state(landing, approach.predicted[0], forces, probe.position)
    budget_exhausted = max(landing.budget_exhausted, approach.budget_exhausted)
    return Outcome(
        center=landing.center,
        contacts=first_of(approach.predicted, contact, NO_CONTACT),
        outcomes=first_of(approach.predicted, outcome, NO_OUTCOME),
        pressing=pressing,
        normal_force=load.size,
        tangential=tangential,
        trailing_force=NO_FORCE,
        torque=torque,
        torsion=moment,
        radius=forces.patch.radius,
        is_late=budget_exhausted > 0.0,
        budget=budget_exhausted,
    )
