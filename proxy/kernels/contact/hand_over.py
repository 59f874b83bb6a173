"""Transfer of deflection and wind-up between several contacts as their load shares change.

Each object that supports the proxy has a separate contact. Its share w of the coupling and of the torsional spring is
its share of the load, the sum of the elastic normal forces. When one contact loses share, another gains it, together
with the deflection and wind-up of that share. They are mixed in proportion to the shares, so the forces are
continuous, and the energy of the springs does not increase, because it is convex.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.rest.active_set import loads_of
from softfinger.proxy.kernels.friction.torsion import torsional_stiffness
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import NO_CONTACT, ActiveSet, Constraint, ContactState, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.objects import material_of
from softfinger.proxy.record import ROLLING

Contacts = tuple[ContactState, ContactState, ContactState]


@jit
def contact_on(contacts: Contacts, body: float) -> ContactState:
    """Return the contact on that object, or NO_CONTACT."""
    if body >= 0.0:
        if contacts[0].body == body:
            return contacts[0]
        if contacts[1].body == body:
            return contacts[1]
        if contacts[2].body == body:
            return contacts[2]
    return NO_CONTACT


@jit
def load_shares(objects: Any, active: ActiveSet) -> Vec3:
    """Return the load shares of the three constraints; they sum to 1."""
    one, two, three = loads_of(objects, active)
    load = one + two + three
    if load > 0.0:
        return one / load, two / load, three / load
    return 1.0, 0.0, 0.0


@jit
def load_share_on(active: ActiveSet, shares: Vec3, body: float) -> float:
    """Return the current load share of object `body`."""
    first, second, third = active
    if body == first.body:
        return shares[0]
    if body == second.body:
        return shares[1]
    if body == third.body:
        return shares[2]
    return 0.0


@jit
def load_share_lost(active: ActiveSet, shares: Vec3, contact: ContactState) -> float:
    """Return the part of the load that a contact loses in this tick."""
    if contact.body < 0.0:
        return 0.0
    return max(contact.share - load_share_on(active, shares, contact.body), 0.0)


@jit
def largest_loser(contacts: Contacts, losses: Vec3) -> ContactState:
    if losses[0] >= losses[1] and losses[0] >= losses[2]:
        return contacts[0]
    if losses[1] >= losses[2]:
        return contacts[1]
    return contacts[2]


@jit
def winding_stiffness(objects: Any, contact: ContactState) -> float:
    """Return the stiffness of the torsional spring of a contact, that of the first object for NO_CONTACT."""
    return torsional_stiffness(material_of(objects, contact.body).torsion)


class LostWindUp(NamedTuple):
    """Deflection and rolled part (3,) m and bend (3,) of the contacts, times the load share that each loses, summed."""

    deflection: Vec3
    rolled_part: Vec3
    bend: Vec3


@jit
def sum_weighted(weights: Vec3, one: Vec3, two: Vec3, three: Vec3) -> Vec3:
    return vec3.add_scaled(vec3.add_scaled(vec3.scale(weights[0], one), weights[1], two), weights[2], three)


@jit
def lost_wind_up(contacts: Contacts, losses: Vec3) -> LostWindUp:
    one, two, three = contacts
    return LostWindUp(
        sum_weighted(losses, one.deflection, two.deflection, three.deflection),
        sum_weighted(losses, one.rolled_part, two.rolled_part, three.rolled_part),
        sum_weighted(losses, one.bend, two.bend, three.bend),
    )


@jit
def lost_spin(contact: ContactState, loss: float, of_contact: float, normal: Vec3, stiffness: float) -> float:
    """Return the spin that the share lost by a contact has on a receiver with that normal and torsional stiffness.

    On a stiffer torsional spring the spin becomes smaller, so the moment is preserved, and no energy is generated.
    """
    if loss == 0.0:
        return 0.0
    return loss * min(of_contact / stiffness, 1.0) * vec3.dot(contact.normal, normal) * contact.spin


@jit
def contact_after_hand_over(
    objects: Any, contacts: Contacts, losses: Vec3, lost: LostWindUp, stiffnesses: Vec3, constraint: Constraint,
    share: float,
) -> ContactState:  # fmt: skip
    """Return the contact of a constraint: the remainder of its last state, plus the state of the share it gained.

    contacts    of the last tick, moved with their objects
    losses      of these contacts, see `load_share_lost`
    lost        their wind-up
    stiffnesses of their torsional springs
    share       current load share of the constraint

    Vectors are projected onto the tangent plane of the constraint, and the spins onto its normal.
    """
    body, normal, push = constraint
    if body < 0.0:
        return NO_CONTACT
    previous = contact_on(contacts, body)
    total_loss = losses[0] + losses[1] + losses[2]
    continues = previous.body >= 0.0
    source = previous if continues or total_loss == 0.0 else largest_loser(contacts, losses)
    remainder, gain = 0.0, 0.0
    if share > 0.0:
        remainder = min(previous.share, share) / share
        if total_loss > 0.0:
            gain = max(share - previous.share, 0.0) / (total_loss * share)
    mode = source.mode if source.body >= 0.0 else float(ROLLING)
    deflection, rolled_part, bend, spin = ZERO, ZERO, vec3.scale(remainder, previous.bend), remainder * previous.spin
    if continues:
        deflection = vec3.scale(remainder, vec3.reject(previous.deflection, normal))
        rolled_part = vec3.scale(remainder, vec3.reject(previous.rolled_part, normal))
    if gain > 0.0:
        deflection = vec3.add_scaled(deflection, gain, vec3.reject(lost.deflection, normal))
        rolled_part = vec3.add_scaled(rolled_part, gain, vec3.reject(lost.rolled_part, normal))
        bend = vec3.add_scaled(bend, gain, vec3.reject(lost.bend, normal))
        stiffness = torsional_stiffness(material_of(objects, body).torsion)
        total = lost_spin(contacts[0], losses[0], stiffnesses[0], normal, stiffness)
        total += lost_spin(contacts[1], losses[1], stiffnesses[1], normal, stiffness)
        total += lost_spin(contacts[2], losses[2], stiffnesses[2], normal, stiffness)
        spin += gain * total
    return ContactState(
        body=body,
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
    shares = load_shares(objects, active)
    losses = (
        load_share_lost(active, shares, contacts[0]),
        load_share_lost(active, shares, contacts[1]),
        load_share_lost(active, shares, contacts[2]),
    )
    one, two, three = contacts
    lost = lost_wind_up(contacts, losses)
    stiffnesses = winding_stiffness(objects, one), winding_stiffness(objects, two), winding_stiffness(objects, three)
    return (
        contact_after_hand_over(objects, contacts, losses, lost, stiffnesses, active[0], shares[0]),
        contact_after_hand_over(objects, contacts, losses, lost, stiffnesses, active[1], shares[1]),
        contact_after_hand_over(objects, contacts, losses, lost, stiffnesses, active[2], shares[2]),
    )
