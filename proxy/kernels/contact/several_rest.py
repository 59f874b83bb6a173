"""Equilibrium position of the proxy with several contacts, after friction."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import Approach
from softfinger.proxy.kernels.contact.contact_friction import ContactForces, Prediction, with_friction_result
from softfinger.proxy.kernels.contact.hand_over import Contacts, find_contact, hand_over
from softfinger.proxy.kernels.contact.prediction import compute_lag
from softfinger.proxy.kernels.contact.rest.active_set import count_constraints, is_enclosed, list_objects
from softfinger.proxy.kernels.contact.rest.cutting_planes import solve_tangent_planes
from softfinger.proxy.kernels.contact.rest.facets import find_constraints_at_rest
from softfinger.proxy.kernels.contact.rest.several_objects import settle_among_several
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each, replace
from softfinger.proxy.kernels.model import NO_CONTACT, ActiveSet, Constraint, ContactState, Finger, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.kinds import has_creases_at
from softfinger.proxy.kernels.shapes.budget import DEEP_SHARE


class Equilibrium(NamedTuple):
    """Proxy at the end of a tick.

    center    (3,) m
    active    constraints at `center`
    contacts  of these constraints
    is_late   True if the proxy is not yet at rest
    budget    remaining budget, below 0 if it was exhausted
    """

    center: Vec3
    active: ActiveSet
    contacts: Contacts
    is_late: bool
    budget: int


@jit
def update_contact(predicted: Prediction, forces: ContactForces) -> ContactState:
    """Return a contact after friction, NO_CONTACT if it has no load."""
    nothing = predicted.contact.object_index < 0.0 or predicted.contact.share <= 0.0
    return NO_CONTACT if nothing else with_friction_result(predicted, forces)


@jit
def move_to_constraint(contact: ContactState, constraint: Constraint) -> ContactState:
    """Return a contact at the constraint of a proxy that has moved over its object."""
    if contact.object_index < 0.0:
        return contact
    n = constraint.normal
    deflection, rolled_part = vec3.reject(contact.deflection, n), vec3.reject(contact.rolled_part, n)
    return replace(contact, "normal", n, "push", constraint.depth, "deflection", deflection, "rolled_part", rolled_part)


@jit
def ease_depth(constraint: Constraint, ease: float) -> Constraint:
    return replace(constraint, "depth", ease * constraint.depth)


@jit
def shift_deflection(contact: ContactState, displacement: Vec3) -> ContactState:
    """Add the tangential part of a displacement (3,) m to the deflection of a contact."""
    if contact.object_index < 0.0:
        return contact
    return replace(contact, "deflection", vec3.add(contact.deflection, vec3.reject(displacement, contact.normal)))


@jit
def settle_after_friction(
    finger: Finger, objects: Any, shapes: Any, approach: Approach, forces: Any, position: Vec3
) -> Equilibrium:
    """Move the proxy to the permitted point nearest to the displaced probe, and update the contacts to its constraints.

    If the probe is below the centre of curvature of the surface on which the proxy moves, that point is not stable: a
    sticking contact would swing round its object. So a probe deeper than `DEEP_SHARE` is raised to that depth, towards
    the position of the proxy if all contacts stick.
    """
    after = map_each(update_contact, (approach.predicted, forces))
    radius, lag, budget = finger.radius, compute_lag(after), approach.budget
    goal, active, ease = vec3.add(position, lag), approach.active, 1.0
    one, two, three = approach.predicted
    shares = one.contact.share, two.contact.share, three.contact.share
    lag_if_stuck = vec3.weighted_sum(shares, one.deflection, two.deflection, three.deflection)
    to_proxy = vec3.sub(approach.center, vec3.add(position, lag_if_stuck))
    depth = vec3.norm(to_proxy)
    if lag != ZERO and depth > DEEP_SHARE * radius:
        ease = DEEP_SHARE * radius / depth
        goal, active = vec3.add_scaled(goal, 1.0 - ease, to_proxy), map_each(ease_depth, (active,), ease)
    if approach.is_single and has_creases_at(shapes, approach.active[0].object_index):
        budget = budget // 4  # the height map was already searched as the only object
    rest = settle_among_several(shapes, radius, goal, approach.start, approach.clear_center, active, budget)
    active = find_constraints_at_rest(shapes, radius, goal, rest)
    contacts = after
    if list_objects(active) != list_objects(after):
        contacts = map_each(find_contact, (active,), after)  # if only the order changes, no load is transferred
        if list_objects(active) != list_objects(contacts) or count_constraints(active) != count_constraints(after):
            contacts = hand_over(objects, after, active)
    contacts = map_each(move_to_constraint, (contacts, active))
    displaced = vec3.add(position, compute_lag(contacts))
    if displaced != goal:
        active, place = solve_tangent_planes(shapes, radius, displaced, rest.center, active)
        contacts = map_each(move_to_constraint, (contacts, active))
        if ease < 1.0 and not rest.is_late and not is_enclosed(active):
            contacts = map_each(shift_deflection, (contacts,), vec3.sub(rest.center, place))
    return Equilibrium(rest.center, active, contacts, rest.is_late, rest.budget)
