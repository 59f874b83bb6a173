"""Prediction of several contacts before friction: moved with their objects, rolled and sheared, as if each stuck.

The proxy c is the permitted point nearest to the displaced probe x + e, e the mean deflection of the contacts. While
all contacts stick, c is at rest on its objects, and the tangent planes there do not rotate.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import NO_PREDICTION, Approach
from softfinger.proxy.kernels.contact.contact_friction import Prediction
from softfinger.proxy.kernels.contact.hand_over import Contacts, find_contact, hand_over
from softfinger.proxy.kernels.contact.rest.cutting_planes import solve_tangent_planes
from softfinger.proxy.kernels.contact.rolling.on_objects import roll_flat_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each, replace
from softfinger.proxy.kernels.model import Constraint, ContactState, FingerState, ProbeMotion, Quaternion, Scene, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.carry import compute_relative_rotation, find_carry, move_point, turn_direction
from softfinger.proxy.kernels.query.objects import compute_curvature
from softfinger.proxy.kernels.shapes.budget import BUDGET


class Shear(NamedTuple):
    """Motion of all contacts in a tick.

    turn               rotation of the fingertip
    free       (3,) m  motion of the probe, plus the change of its displacement by the pushes
    blocked    (3,) m  motion of the probe that the proxy could not follow because of the pushes
    reference  (3,) m  the probe at the last tick, displaced by the pushes
    """

    turn: Quaternion
    free: Vec3
    blocked: Vec3
    reference: Vec3


class ContactRoll(NamedTuple):
    """Roll of one contact in a tick.

    proxy  (3,) m  motion of the proxy, u
    probe  (3,) m  motion of a probe that winds up nothing
    tilt   (3,) m  d W u: displacement of the proxy from the probe as its normal rotates, see `predict`
    spin   rad     rotation about the normal
    theta  rad     roll angle
    """

    proxy: Vec3
    probe: Vec3
    tilt: Vec3
    spin: float
    theta: float


@jit
def compute_lag(contacts: Contacts) -> Vec3:
    """Return the mean deflection (3,) m of the contacts, weighted by their load shares."""
    one, two, three = contacts
    shares = one.share, two.share, three.share
    return vec3.weighted_sum(shares, one.deflection, two.deflection, three.deflection)


@jit
def move_contact(contact: ContactState, objects: Any) -> ContactState:
    """Return the contact moved with its object."""
    if contact.object_index < 0.0:
        return contact
    carry = find_carry(objects, contact.object_index)
    normal, deflection = turn_direction(carry, contact.normal), turn_direction(carry, contact.deflection)
    rolled_part, bend = turn_direction(carry, contact.rolled_part), turn_direction(carry, contact.bend)
    return replace(contact, "normal", normal, "deflection", deflection, "rolled_part", rolled_part, "bend", bend)


@jit
def compute_displacement_by_push(contact: ContactState, before: Contacts) -> Vec3:
    """Return the displacement (3,) m of the proxy in this tick because the push of a contact has changed."""
    return vec3.scale(contact.push - find_contact(contact, before).push, contact.normal)


@jit
def displace_by_pushes(position: Vec3, contacts: Contacts) -> Vec3:
    """Return `position` (3,) m displaced by the pushes of the contacts."""
    one, two, three = contacts
    pushes = one.push, two.push, three.push
    return vec3.add(position, vec3.weighted_sum(pushes, one.normal, two.normal, three.normal))


@jit
def compute_shear(state: FingerState, last: Contacts, contacts: Contacts, motion: ProbeMotion) -> Shear:
    """Return the motion of the contacts; `last` are the contacts of the last tick, moved with their objects."""
    probe, last_probe, _ = motion
    one, two, three = map_each(compute_displacement_by_push, (contacts,), last)
    by_push = vec3.add(vec3.add(one, two), three)
    reference = displace_by_pushes(last_probe.position, state.contacts)
    return Shear(
        turn=rotations.relative(probe.orientation, last_probe.orientation),
        free=vec3.add(vec3.sub(displace_by_pushes(probe.position, last), reference), by_push),
        blocked=vec3.scale(-1.0, by_push),
        reference=reference,
    )


@jit
def roll_contact(
    contact: ContactState, method: Any, objects: Any, radius: float, center: Vec3, turn: Quaternion
) -> ContactRoll:
    """Roll a contact by the rotation `turn` of the fingertip in this tick, in its tangent plane.

    center  (3,) m  proxy before the roll
    """
    if contact.object_index < 0.0:
        return ContactRoll(ZERO, ZERO, ZERO, 0.0, 0.0)
    normal, carry = contact.normal, find_carry(objects, contact.object_index)
    rolled = roll_flat_on(method, objects, contact.object_index, radius, normal, compute_relative_rotation(carry, turn))
    k1, k2, along = compute_curvature(objects, contact.object_index, radius, center, normal)
    # At a product of 1 of depth and curvature, the probe is at the centre of curvature and does not move.
    first, second, probe = min(contact.push * k1, 1.0), min(contact.push * k2, 1.0), rolled.motion
    if first != 0.0 or second != 0.0:  # u - d dn/dp u
        across = vec3.cross(normal, along)
        probe = vec3.add_scaled(probe, -first * vec3.dot(probe, along), along)
        probe = vec3.add_scaled(probe, -second * vec3.dot(probe, across), across)
    return ContactRoll(rolled.motion, probe, vec3.sub(rolled.motion, probe), rolled.spin, rolled.theta)


@jit
def predict(contact: ContactState, roll: ContactRoll, tilted: Vec3, objects: Any, shear: Shear) -> Prediction:
    """Compute the deflection of a sticking contact after the motions of probe, object and fingertip.

    tilted  (3,) m  displacement of the proxy as its normals at the other contacts rotate

    e <- e - (dx - do) + (1 - d W) r theta (a x n) - sum d_j W_j u_j, all in the tangent plane: x the probe, including
    its displacement by the pushes, o the object at that point, d the depth, W = dn/dp of the surface on
    which the proxy moves, and j the other contacts. If the proxy rolls by u on all of them and the probe moves by
    u - sum d_j W_j u, nothing is wound up.
    The part of the probe's motion that the proxy could not follow counts only if it unwinds e. So the contact
    returns no more work to the hand than its spring stores, independent of the other contacts.
    """
    if contact.object_index < 0.0:
        return NO_PREDICTION
    normal, carry = contact.normal, find_carry(objects, contact.object_index)
    object_motion = vec3.sub(move_point(carry, shear.reference), shear.reference)
    shear_motion = vec3.reject(vec3.sub(shear.free, object_motion), normal)
    roll_motion = vec3.sub(roll.probe, vec3.reject(tilted, normal))
    deflection = vec3.add(vec3.sub(contact.deflection, shear_motion), roll_motion)
    blocked = vec3.reject(shear.blocked, normal)
    square = vec3.dot(blocked, blocked)
    if square > 0.0:
        share = min(max(vec3.dot(deflection, blocked) / square, 0.0), 1.0)
        deflection = vec3.add_scaled(deflection, -share, blocked)
    contact_with_roll = replace(contact, "rolled_part", vec3.add(contact.rolled_part, roll_motion))
    return Prediction(contact_with_roll, deflection, roll.spin, False)


@jit
def continue_several(
    scene: Scene, objects: Any, shapes: Any, radius: float, state: FingerState, motion: ProbeMotion
) -> Approach:
    """Continue all contacts of the last tick, each moved with its object."""
    last = map_each(move_contact, (state.contacts,), shapes)
    center = move_point(find_carry(shapes, last[0].object_index), state.center)
    base = vec3.add(motion.probe.position, compute_lag(last))
    active = (
        Constraint(last[0].object_index, last[0].normal, last[0].push),
        Constraint(last[1].object_index, last[1].normal, last[1].push),
        Constraint(last[2].object_index, last[2].normal, last[2].push),
    )
    active, _ = solve_tangent_planes(shapes, radius, base, center, active)
    contacts = hand_over(objects, last, active)
    shear = compute_shear(state, last, contacts, motion)
    rolls = map_each(roll_contact, (contacts,), scene.rolling, shapes, radius, center, shear.turn)
    one, two, three = rolls
    tilts = vec3.add(two.tilt, three.tilt), vec3.add(one.tilt, three.tilt), vec3.add(one.tilt, two.tilt)
    rolled = vec3.add_scaled(vec3.add_scaled(center, contacts[0].share, one.proxy), contacts[1].share, two.proxy)
    return Approach(
        start=state.center,
        clear_center=center,
        center=vec3.add_scaled(rolled, contacts[2].share, three.proxy),
        active=active,
        predicted=map_each(predict, (contacts, rolls, tilts), shapes, shear),
        rolled=state.rolled + one.theta,
        center_lacks_roll=True,
        is_single=False,
        is_new=False,
        budget_exhausted=0.0,
        budget=BUDGET,
        stuck_ticks=state.stuck_ticks,
    )
