"""Prediction of several contacts before friction: moved with their objects, rolled and sheared, as if each stuck.

The proxy c is the permitted point nearest to the displaced probe x + e, e the mean deflection of the contacts. While
all contacts stick, c is at rest on its objects, and the tangent planes there do not rotate.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import NO_PREDICTION, Approach
from softfinger.proxy.kernels.contact.contact_friction import Prediction, ProbeMotion
from softfinger.proxy.kernels.contact.hand_over import Contacts, contact_on, hand_over
from softfinger.proxy.kernels.contact.rest.cutting_planes import solve_tangent_planes
from softfinger.proxy.kernels.contact.rolling.on_objects import roll_flat_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import ActiveSet, Constraint, ContactState, FingerState, Quaternion, Scene, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.carry import carry, move_point, relative_rotation, turn_direction
from softfinger.proxy.kernels.query.objects import curvature_of
from softfinger.proxy.kernels.shapes.budget import BUDGET


class Shear(NamedTuple):
    """Motion of all contacts in a tick.

    turn              rotation of the fingertip
    free     (3,)  m  motion of the probe, plus the change of its displacement by the pushes
    blocked  (3,)  m  motion of the probe that the proxy could not follow because of the pushes
    reference (3,) m  the probe at the last tick, displaced by the pushes
    """

    turn: Quaternion
    free: Vec3
    blocked: Vec3
    reference: Vec3


class ContactRoll(NamedTuple):
    """Roll of one contact in a tick.

    proxy  (3,) m  motion of the proxy
    probe  (3,) m  motion of a probe that winds up nothing
    spin   rad     rotation about the normal
    theta  rad     roll angle
    """

    proxy: Vec3
    probe: Vec3
    spin: float
    theta: float


class Lever(NamedTuple):
    """Fractions by which the probe moves less than a proxy that rolls on a curved surface; negative in a hollow.

    first        along the unit tangent `along`
    second       across it
    along  (3,)
    """

    first: float
    second: float
    along: Vec3


@jit
def lag_of(contacts: Contacts) -> Vec3:
    """Return the mean deflection (3,) m of the contacts, weighted by their load shares."""
    one, two, three = contacts
    lag = vec3.scale(one.share, one.deflection)
    return vec3.add_scaled(vec3.add_scaled(lag, two.share, two.deflection), three.share, three.deflection)


@jit
def move_contact(objects: Any, contact: ContactState) -> ContactState:
    """Return the contact moved with its object."""
    if contact.body < 0.0:
        return contact
    carried = carry(objects, contact.body)
    normal, deflection = turn_direction(carried, contact.normal), turn_direction(carried, contact.deflection)
    rolled_part, bend = turn_direction(carried, contact.rolled_part), turn_direction(carried, contact.bend)
    return replace(contact, "normal", normal, "deflection", deflection, "rolled_part", rolled_part, "bend", bend)


@jit
def move_contacts(objects: Any, contacts: Any) -> Contacts:
    return (
        move_contact(objects, contacts[0]),
        move_contact(objects, contacts[1]),
        move_contact(objects, contacts[2]),
    )


@jit
def constraints_of_contacts(contacts: Contacts) -> ActiveSet:
    """Return the constraints of contacts, with the pushes of the last tick."""
    one, two, three = contacts
    return (
        Constraint(one.body, one.normal, one.push),
        Constraint(two.body, two.normal, two.push),
        Constraint(three.body, three.normal, three.push),
    )


@jit
def displacement_by_push(before: Contacts, contact: ContactState) -> Vec3:
    """Return the displacement (3,) m of the proxy in this tick because the push of a contact has changed."""
    return vec3.scale(contact.push - contact_on(before, contact.body).push, contact.normal)


@jit
def displacement_by_rotation(before: ContactState, carried: ContactState) -> Vec3:
    """Return the displacement (3,) m of the proxy in this tick because the object of a contact rotates."""
    return vec3.scale(before.push, vec3.sub(carried.normal, before.normal))


@jit
def displaced_by(position: Vec3, contacts: Contacts) -> Vec3:
    """Return `position` (3,) m displaced by the pushes of the contacts."""
    one, two, three = contacts
    position = vec3.add_scaled(position, one.push, one.normal)
    return vec3.add_scaled(vec3.add_scaled(position, two.push, two.normal), three.push, three.normal)


@jit
def shear_of(state: FingerState, last: Contacts, contacts: Contacts, motion: ProbeMotion) -> Shear:
    """Return the motion of the contacts; `last` are the contacts of the last tick, moved with their objects."""
    probe, last_probe, _ = motion
    by_push = vec3.add(displacement_by_push(last, contacts[0]), displacement_by_push(last, contacts[1]))
    by_push = vec3.add(by_push, displacement_by_push(last, contacts[2]))
    one, two, three = state.contacts
    by_rotation = vec3.add(displacement_by_rotation(one, last[0]), displacement_by_rotation(two, last[1]))
    by_rotation = vec3.add(by_rotation, displacement_by_rotation(three, last[2]))
    return Shear(
        turn=rotations.relative(probe.orientation, last_probe.orientation),
        free=vec3.add(vec3.add(vec3.sub(probe.position, last_probe.position), by_push), by_rotation),
        blocked=vec3.scale(-1.0, by_push),
        reference=displaced_by(last_probe.position, state.contacts),
    )


@jit
def lever_of(objects: Any, contact: ContactState, radius: float, center: Vec3) -> Lever:
    """Return depth times curvature of the surface on which the proxy, at `center` (3,) m, moves.

    Neither product exceeds 1 in size. At 1, the probe is at the centre of curvature and does not move.
    """
    k1, k2, along = curvature_of(objects, contact.body, radius, center, contact.normal)
    largest = max(abs(k1), abs(k2)) * contact.push
    depth = contact.push / largest if largest > 1.0 else contact.push
    return Lever(depth * k1, depth * k2, along)


@jit
def apply_lever(lever: Lever, normal: Vec3, v: Vec3) -> Vec3:
    """Convert a tangential motion `v` (3,) of the proxy to that of the probe: v - depth dn/dp v."""
    if lever.first == 0.0 and lever.second == 0.0:
        return v
    across = vec3.cross(normal, lever.along)
    v = vec3.add_scaled(v, -lever.first * vec3.dot(v, lever.along), lever.along)
    return vec3.add_scaled(v, -lever.second * vec3.dot(v, across), across)


@jit
def roll_contact(
    method: Any, objects: Any, radius: float, center: Vec3, contact: ContactState, turn: Quaternion
) -> ContactRoll:
    """Roll a contact by the rotation `turn` of the fingertip in this tick, in its tangent plane."""
    if contact.body < 0.0:
        return ContactRoll(ZERO, ZERO, 0.0, 0.0)
    normal, carried = contact.normal, carry(objects, contact.body)
    rolled = roll_flat_on(method, objects, contact.body, radius, normal, relative_rotation(carried, turn))
    motion_of_probe = apply_lever(lever_of(objects, contact, radius, center), normal, rolled.motion)
    return ContactRoll(rolled.motion, motion_of_probe, rolled.spin, rolled.theta)


@jit
def predict(objects: Any, contact: ContactState, shear: Shear, roll: ContactRoll, tilted: Vec3) -> Prediction:
    """Compute the deflection of a sticking contact after the motions of probe, object and fingertip.

    tilted  (3,) m  displacement of the proxy as its normals at the other contacts rotate, see `tilt_of`

    e <- e - (dx - do) + (1 - d W) r theta (a x n) - sum d_j W_j u_j, all in the tangent plane: x the probe, including
    the change of its displacement by the pushes, o the object at the probe, d the depth, W = dn/dp of the surface on
    which the proxy moves, and j the other contacts. If the proxy rolls by u on all of them and the probe moves by
    u - sum d_j W_j u, nothing is wound up.
    The part of the probe's motion that the proxy could not follow counts only if it unwinds e. So the contact
    returns no more work to the hand than its spring stores, independent of the other contacts.
    """
    if contact.body < 0.0:
        return NO_PREDICTION
    normal, carried = contact.normal, carry(objects, contact.body)
    object_motion = vec3.sub(move_point(carried, shear.reference), shear.reference)
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
def tilt_of(roll: ContactRoll) -> Vec3:
    """Return d W u (3,) m: the displacement of the proxy from the probe as its normal rotates in a roll by u."""
    return vec3.sub(roll.proxy, roll.probe)


@jit
def continue_several(
    scene: Scene, objects: Any, shapes: Any, radius: float, state: FingerState, motion: ProbeMotion
) -> Approach:
    """Continue all contacts of the last tick, each moved with its object."""
    last = move_contacts(shapes, state.contacts)
    center = move_point(carry(shapes, last[0].body), state.center)
    base = vec3.add(motion.probe.position, lag_of(last))
    active, _ = solve_tangent_planes(shapes, radius, base, center, constraints_of_contacts(last))
    contacts = hand_over(objects, last, active)
    shear = shear_of(state, last, contacts, motion)
    roll1 = roll_contact(scene.rolling, shapes, radius, center, contacts[0], shear.turn)
    roll2 = roll_contact(scene.rolling, shapes, radius, center, contacts[1], shear.turn)
    roll3 = roll_contact(scene.rolling, shapes, radius, center, contacts[2], shear.turn)
    tilt1, tilt2, tilt3 = tilt_of(roll1), tilt_of(roll2), tilt_of(roll3)
    one = predict(shapes, contacts[0], shear, roll1, vec3.add(tilt2, tilt3))
    two = predict(shapes, contacts[1], shear, roll2, vec3.add(tilt1, tilt3))
    three = predict(shapes, contacts[2], shear, roll3, vec3.add(tilt1, tilt2))
    rolled = vec3.add_scaled(vec3.add_scaled(center, contacts[0].share, roll1.proxy), contacts[1].share, roll2.proxy)
    return Approach(
        start=state.center,
        outside=center,
        center=vec3.add_scaled(rolled, contacts[2].share, roll3.proxy),
        active=active,
        predicted=(one, two, three),
        rolled=state.rolled + roll1.theta,
        strays=True,
        single=False,
        began=False,
        bounded=0.0,
        budget=BUDGET,
        stuck=state.stuck,
    )
