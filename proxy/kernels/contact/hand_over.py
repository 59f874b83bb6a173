"""Transfer of deflection and wind-up between several contacts as their load shares change.

Each object that supports the proxy has a separate contact. Its share w of the coupling and of the torsional spring is
its share of the load, the sum of the elastic normal forces. When one contact loses share, another gains it, together
with the deflection and wind-up of that share. They are mixed in proportion to the shares, so the forces are
continuous, and the energy of the springs does not increase, because it is convex.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.rest.active_set import compute_spring_load
from softfinger.proxy.kernels.friction.torsion import find_spring, find_torsional_stiffness
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import NO_CONTACT, ActiveSet, Constraint, ContactState, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.record import ROLLING

Contacts = tuple[ContactState, ContactState, ContactState]


@jit
def find_contact(constraint: Any, contacts: Contacts) -> ContactState:
    """Return the contact on the object of a constraint, or of another contact; NO_CONTACT if there is none."""
    index = constraint.object_index
    if index >= 0.0:
        if contacts[0].object_index == index:
            return contacts[0]
        if contacts[1].object_index == index:
            return contacts[1]
        if contacts[2].object_index == index:
            return contacts[2]
    return NO_CONTACT


@jit
def compute_lost_share(contact: ContactState, active: ActiveSet, shares: Vec3) -> float:
    """Return the part of the load that a contact loses in this tick."""
    if contact.object_index < 0.0:
        return 0.0
    share = 0.0
    if contact.object_index == active[0].object_index:
        share = shares[0]
    elif contact.object_index == active[1].object_index:
        share = shares[1]
    elif contact.object_index == active[2].object_index:
        share = shares[2]
    return max(contact.share - share, 0.0)


@jit
def find_largest_loser(contacts: Contacts, losses: Vec3) -> ContactState:
    if losses[0] >= losses[1] and losses[0] >= losses[2]:
        return contacts[0]
    return contacts[1] if losses[1] >= losses[2] else contacts[2]


@jit
def find_winding_stiffness(contact: ContactState, objects: Any) -> float:
    """Return the stiffness of the torsional spring of a contact, that of the first object for NO_CONTACT."""
    return find_torsional_stiffness(find_spring(find_object(objects, contact.object_index).material.torsion))


class LostWindUp(NamedTuple):
    """Deflection and rolled part (3,) m and bend (3,) of the contacts, times the load share that each loses, summed."""

    deflection: Vec3
    rolled_part: Vec3
    bend: Vec3


@jit
def compute_lost_spin(contact: ContactState, loss: float, of_contact: float, normal: Vec3, stiffness: float) -> float:
    """Return the spin that the share lost by a contact has on a receiver with that normal and torsional stiffness.

    On a stiffer torsional spring the spin becomes smaller, so the moment is preserved, and no energy is generated.
    """
    if loss == 0.0:
        return 0.0
    return loss * min(of_contact / stiffness, 1.0) * vec3.dot(contact.normal, normal) * contact.spin


@jit
def mix_contact(
    constraint: Constraint, share: float, objects: Any, contacts: Contacts, losses: Vec3, lost: LostWindUp,
    stiffnesses: Vec3,
) -> ContactState:  # fmt: skip
    """Return the contact of a constraint: the remainder of its last state, plus the state of the share it gained.

    share       current load share of the constraint
    contacts    of the last tick, moved with their objects
    losses      of these contacts, see `compute_lost_share`
    lost        their wind-up
    stiffnesses of their torsional springs

    Vectors are projected onto the tangent plane of the constraint, and the spins onto its normal.
    """
    index, normal, push = constraint
    if index < 0.0:
        return NO_CONTACT
    previous = find_contact(constraint, contacts)
    total_loss = losses[0] + losses[1] + losses[2]
    continues = previous.object_index >= 0.0
    source = previous if continues or total_loss == 0.0 else find_largest_loser(contacts, losses)
    remainder, gain = 0.0, 0.0
    if share > 0.0:
        remainder = min(previous.share, share) / share
        if total_loss > 0.0:
            gain = max(share - previous.share, 0.0) / (total_loss * share)
    mode = source.mode if source.object_index >= 0.0 else float(ROLLING)
    deflection, rolled_part, bend, spin = ZERO, ZERO, vec3.scale(remainder, previous.bend), remainder * previous.spin
    if continues:
        deflection = vec3.scale(remainder, vec3.reject(previous.deflection, normal))
        rolled_part = vec3.scale(remainder, vec3.reject(previous.rolled_part, normal))
    if gain > 0.0:
        deflection = vec3.add_scaled(deflection, gain, vec3.reject(lost.deflection, normal))
        rolled_part = vec3.add_scaled(rolled_part, gain, vec3.reject(lost.rolled_part, normal))
        bend = vec3.add_scaled(bend, gain, vec3.reject(lost.bend, normal))
        stiffness = find_torsional_stiffness(find_spring(find_object(objects, index).material.torsion))
        spins = map_each(compute_lost_spin, (contacts, losses, stiffnesses), normal, stiffness)
        spin += gain * (spins[0] + spins[1] + spins[2])
    return ContactState(
        object_index=index,
        normal=normal,
        push=push,
        share=share,
        mode=mode,
        deflection=deflection,
        rolled_part=rolled_part,
        spin=spin,
        slip_speed=source.slip_speed,
        slip_deflection=source.slip_deflection,
        spin_slip_speed=source.spin_slip_speed,
        spin_slip_angle=source.spin_slip_angle,
        bend=bend,
    )


@jit
def hand_over(objects: Any, contacts: Contacts, active: ActiveSet) -> Contacts:
    """Return the contacts of this tick, one per constraint of the proxy, before they are moved."""
    loads, shares = map_each(compute_spring_load, (active,), objects), (1.0, 0.0, 0.0)
    load = loads[0] + loads[1] + loads[2]
    if load > 0.0:
        shares = loads[0] / load, loads[1] / load, loads[2] / load
    losses = map_each(compute_lost_share, (contacts,), active, shares)
    one, two, three = contacts
    lost = LostWindUp(
        vec3.weighted_sum(losses, one.deflection, two.deflection, three.deflection),
        vec3.weighted_sum(losses, one.rolled_part, two.rolled_part, three.rolled_part),
        vec3.weighted_sum(losses, one.bend, two.bend, three.bend),
    )
    stiffnesses = map_each(find_winding_stiffness, (contacts,), objects)
    return map_each(mix_contact, (active, shares), objects, contacts, losses, lost, stiffnesses)
