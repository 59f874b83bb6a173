"""Prediction of several contacts before friction: moved with their objects, rolled and sheared, as if each stuck.

The proxy c is the permitted point nearest to the displaced probe x + e, e the mean deflection of the contacts. While
all contacts stick, c is at rest on its objects, and the tangent planes there do not rotate.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import NO_PREDICTION, Approach
from softfinger.proxy.kernels.contact.carry import carry, move_point, relative_rotation, turn_direction
from softfinger.proxy.kernels.contact.contact_friction import Prediction, ProbeMotion
from softfinger.proxy.kernels.contact.hand_over import Contacts, contact_on, hand_over
from softfinger.proxy.kernels.contact.rest.cutting_planes import pushed_at
from softfinger.proxy.kernels.contact.rolling.on_objects import roll_flat_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    ActiveSet,
    Constraint,
    ContactState,
    FingerState,
    Quaternion,
    Scene,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.objects import curvature_of
from softfinger.proxy.kernels.shapes.budget import BUDGET


class Shear(NamedTuple):
    """Motion of all contacts in a tick.

    turn              rotation of the fingertip
    free     (3,)  m  motion of the probe, plus the change of its displacement by the pushes
    blocked  (3,)  m  motion of the probe that the pushes kept the proxy from following
    center   (3,)  m  the proxy at the last tick
    """

    turn: Quaternion
    free: Vec3
    blocked: Vec3
    center: Vec3


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
    moved = carry(objects, contact.body)
    normal, deflection = turn_direction(moved, contact.normal), turn_direction(moved, contact.deflection)
    rolled_part, bend = turn_direction(moved, contact.rolled_part), turn_direction(moved, contact.bend)
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
def shear_of(state: FingerState, last: Contacts, contacts: Contacts, motion: ProbeMotion) -> Shear:
    """Return the motion of the contacts; `last` are those of the last tick, moved with their objects."""
    probe, before, _ = motion
    way = vec3.add(displacement_by_push(last, contacts[0]), displacement_by_push(last, contacts[1]))
    way = vec3.add(way, displacement_by_push(last, contacts[2]))
    one, two, three = state.contacts
    rode = vec3.add(displacement_by_rotation(one, last[0]), displacement_by_rotation(two, last[1]))
    rode = vec3.add(rode, displacement_by_rotation(three, last[2]))
    return Shear(
        turn=rotations.relative(probe.orientation, before.orientation),
        free=vec3.add(vec3.add(vec3.sub(probe.position, before.position), way), rode),
        blocked=vec3.scale(-1.0, way),
        center=state.center,
    )


@jit
def lever_of(objects: Any, contact: ContactState, radius: float, center: Vec3) -> Lever:
    """Return depth times curvature of the surface on which the proxy, at `center` (3,) m, moves.

    Neither product exceeds 1 in size. At 1, the probe is at the centre of curvature and does not move.
    """
    k1, k2, along = curvature_of(objects, contact.body, radius, center, contact.normal)
    most = max(abs(k1), abs(k2)) * contact.push
    depth = contact.push / most if most > 1.0 else contact.push
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
def predict(
    method: Any, objects: Any, radius: float, center: Vec3, contact: ContactState, shear: Shear
) -> tuple[Prediction, Vec3, float]:
    """Compute the deflection of a sticking contact after the motions of probe, object and fingertip.

    returns  Prediction, motion (3,) m of the proxy by the roll, roll angle, rad

    e <- e - (dx - do) + (1 - d W) r theta (a x n), all in the tangent plane: x the probe, including the change of its
    displacement by the pushes, o the object at the probe, d the depth, W = dn/dp of the surface on which the proxy
    moves. If the proxy rolls by u and the probe moves by (1 - d W) u, nothing is wound up.
    The part of the probe's motion that the proxy was kept from following counts only if it unwinds e. So the contact
    returns no more work to the hand than its spring stores, independent of the other contacts.
    """
    if contact.body < 0.0:
        return NO_PREDICTION, (0.0, 0.0, 0.0), 0.0
    normal, carried = contact.normal, carry(objects, contact.body)
    rolled = roll_flat_on(method, objects, contact.body, radius, normal, relative_rotation(carried, shear.turn))
    rode = vec3.sub(move_point(carried, shear.center), shear.center)
    way = vec3.reject(vec3.sub(shear.free, rode), normal)
    wound = apply_lever(lever_of(objects, contact, radius, center), normal, rolled.motion)
    deflection = vec3.add(vec3.sub(contact.deflection, way), wound)
    blocked = vec3.reject(shear.blocked, normal)
    square = vec3.dot(blocked, blocked)
    if square > 0.0:
        share = min(max(vec3.dot(deflection, blocked) / square, 0.0), 1.0)
        deflection = vec3.add_scaled(deflection, -share, blocked)
    wound_part = replace(contact, "rolled_part", vec3.add(contact.rolled_part, wound))
    return Prediction(wound_part, deflection, rolled.spin, False), rolled.motion, rolled.theta


@jit
def continue_several(
    scene: Scene, objects: Any, shapes: Any, radius: float, state: FingerState, motion: ProbeMotion
) -> Approach:
    """Continue all contacts of the last tick, each moved with its object."""
    last = move_contacts(shapes, state.contacts)
    center = move_point(carry(shapes, last[0].body), state.center)
    base = vec3.add(motion.probe.position, lag_of(last))
    active, _ = pushed_at(shapes, radius, base, center, constraints_of_contacts(last))
    contacts = hand_over(objects, last, active)
    shear = shear_of(state, last, contacts, motion)
    one, roll1, theta = predict(scene.rolling, shapes, radius, center, contacts[0], shear)
    two, roll2, _ = predict(scene.rolling, shapes, radius, center, contacts[1], shear)
    three, roll3, _ = predict(scene.rolling, shapes, radius, center, contacts[2], shear)
    rolled = vec3.add_scaled(vec3.add_scaled(center, contacts[0].share, roll1), contacts[1].share, roll2)
    return Approach(
        start=state.center,
        outside=center,
        center=vec3.add_scaled(rolled, contacts[2].share, roll3),
        active=active,
        predicted=(one, two, three),
        rolled=state.rolled + theta,
        strays=True,
        single=False,
        began=False,
        bounded=0.0,
        budget=BUDGET,
        stuck=state.stuck,
    )
