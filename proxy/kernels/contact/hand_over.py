"""Contacts with several objects at once: what each hands on to the others as their shares of the load change.

Each object that holds the proxy has a contact of its own, with the share w of the coupling's and the torsional
spring that it has of the load (the elastic normal forces). What one loses of its share another gains, and with the
share goes what it holds: deflection and wind-up mix as the shares do, so the forces are continuous, and the springs'
energy does not grow, since it is convex.
"""

from typing import Any

from softfinger.proxy.kernels.contact.rest.active_set import loads_of
from softfinger.proxy.kernels.friction.torsion import torsional_stiffness
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import NO_CONTACT, ActiveSet, Constraint, ContactState, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.objects import material_of
from softfinger.proxy.record import ROLLING

Contacts = tuple[ContactState, ContactState, ContactState]


@jit
def contact_on(contacts: Contacts, body: float) -> ContactState:
    """The contact on that object, or none."""
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
    """Shares of the load that the three bear; they sum to 1."""
    one, two, three = loads_of(objects, active)
    load = one + two + three
    if load > 0.0:
        return one / load, two / load, three / load
    return 1.0, 0.0, 0.0


@jit
def load_share_on(active: ActiveSet, shares: Vec3, body: float) -> float:
    """The share that the object with that place in the tuple has now."""
    one, two, three = active
    if body == one.body:
        return shares[0]
    if body == two.body:
        return shares[1]
    if body == three.body:
        return shares[2]
    return 0.0


@jit
def load_share_lost(active: ActiveSet, shares: Vec3, contact: ContactState) -> float:
    """How much of its share a contact loses in this tick."""
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
def merged(objects: Any, taker: ContactState, giver: ContactState, weight: float) -> Any:
    """The contact with what `weight`, a share of its own, brings along from another: what lies in its plane, about its
    normal. Wind-up about a stiffer spring is less: the moment is kept, and no energy comes of it."""
    if weight == 0.0:
        return taker
    ease = torsional_stiffness(material_of(objects, giver.body).torsion)
    ease = min(ease / torsional_stiffness(material_of(objects, taker.body).torsion), 1.0)
    turned = vec3.dot(giver.normal, taker.normal)
    deflection = vec3.add_scaled(taker.deflection, weight, vec3.reject(giver.deflection, taker.normal))
    rolled_part = vec3.add_scaled(taker.rolled_part, weight, vec3.reject(giver.rolled_part, taker.normal))
    bend = vec3.add_scaled(taker.bend, weight, vec3.reject(giver.bend, taker.normal))
    spin = taker.spin + weight * ease * turned * giver.spin
    return replace(taker, "deflection", deflection, "rolled_part", rolled_part, "spin", spin, "bend", bend)


@jit
def handed_over(objects: Any, contacts: Contacts, losses: Vec3, constraint: Constraint, share: float) -> ContactState:
    """The contact on an object with what it keeps of its own, and what comes with the share that it has gained.

    contacts, losses   of the last tick, carried; see `load_share_lost`
    """
    body, normal, push = constraint
    if body < 0.0:
        return NO_CONTACT
    own = contact_on(contacts, body)
    lost = losses[0] + losses[1] + losses[2]
    keeps = own.body >= 0.0
    like = own if keeps or lost == 0.0 else largest_loser(contacts, losses)
    kept, gained = 0.0, 0.0
    if share > 0.0:
        kept = min(own.share, share) / share
        if lost > 0.0:
            gained = max(share - own.share, 0.0) / (lost * share)
    mode = like.mode if like.body >= 0.0 else float(ROLLING)
    zero = (0.0, 0.0, 0.0)
    deflection, rolled_part = zero, zero
    if keeps:
        deflection = vec3.scale(kept, vec3.reject(own.deflection, normal))
        rolled_part = vec3.scale(kept, vec3.reject(own.rolled_part, normal))
    contact = ContactState(
        body=body,
        normal=normal,
        push=push,
        share=share,
        mode=mode,
        deflection=deflection,
        rolled_part=rolled_part,
        spin=kept * own.spin,
        slip_speed=like.slip_speed,
        slip_deflection=like.slip_deflection,
        spin_slip_speed=like.spin_slip_speed,
        spin_slip_angle=like.spin_slip_angle,
        bend=vec3.scale(kept, own.bend),
    )
    contact = merged(objects, contact, contacts[0], gained * losses[0])
    contact = merged(objects, contact, contacts[1], gained * losses[1])
    return merged(objects, contact, contacts[2], gained * losses[2])


@jit
def hand_over(objects: Any, contacts: Contacts, active: ActiveSet) -> Contacts:
    """The contacts of this tick, one for each that holds the proxy now, before anything has moved them."""
    shares = load_shares(objects, active)
    losses = (
        load_share_lost(active, shares, contacts[0]),
        load_share_lost(active, shares, contacts[1]),
        load_share_lost(active, shares, contacts[2]),
    )
    return (
        handed_over(objects, contacts, losses, active[0], shares[0]),
        handed_over(objects, contacts, losses, active[1], shares[1]),
        handed_over(objects, contacts, losses, active[2], shares[2]),
    )
