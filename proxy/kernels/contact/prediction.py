"""Several contacts before friction: carried along by their objects, rolled and sheared, as if each stuck.

The proxy c is the point nearest to the displaced probe x + e, e the mean deflection of the contacts, that no object
forbids. While all contacts stick, c is at rest on its objects, and the tangent planes there do not turn.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import carried_direction, carried_point, carry, relative_rotation
from softfinger.proxy.kernels.contact.contact_friction import Prediction, ProbeMotion
from softfinger.proxy.kernels.contact.detection import NO_PREDICTION, Approach
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

    turn           rotation of the fingertip
    free     (3,)  m  way of the probe, displaced by what pushes more or less than before
    blocked  (3,)  m  way of the probe that the proxy was kept from
    center   (3,)  m  the proxy at the last tick
    """

    turn: Quaternion
    free: Vec3
    blocked: Vec3
    center: Vec3


class Lever(NamedTuple):
    """By which shares a probe moves less than the proxy that rolls on a curved surface: `first` along the unit tangent
    `along` (3,), `second` across it. In a hollow they are negative."""

    first: float
    second: float
    along: Vec3


@jit
def lag_of(contacts: Contacts) -> Vec3:
    """Mean deflection (3,) m of the contacts, by their shares of the load."""
    one, two, three = contacts
    lag = vec3.scale(one.share, one.deflection)
    return vec3.add_scaled(vec3.add_scaled(lag, two.share, two.deflection), three.share, three.deflection)


@jit
def carried_contact(objects: Any, contact: ContactState) -> ContactState:
    """The contact where its object has taken it."""
    if contact.body < 0.0:
        return contact
    moved = carry(objects, contact.body)
    normal, deflection = carried_direction(moved, contact.normal), carried_direction(moved, contact.deflection)
    rolled_part, bend = carried_direction(moved, contact.rolled_part), carried_direction(moved, contact.bend)
    return replace(contact, "normal", normal, "deflection", deflection, "rolled_part", rolled_part, "bend", bend)


@jit
def carried_contacts(objects: Any, contacts: Any) -> Contacts:
    return (
        carried_contact(objects, contacts[0]),
        carried_contact(objects, contacts[1]),
        carried_contact(objects, contacts[2]),
    )


@jit
def constraints_of_contacts(contacts: Contacts) -> ActiveSet:
    """The constraints of contacts, pushing as they did."""
    one, two, three = contacts
    return (
        Constraint(one.body, one.normal, one.push),
        Constraint(two.body, two.normal, two.push),
        Constraint(three.body, three.normal, three.push),
    )


@jit
def displaced_by_push(before: Contacts, contact: ContactState) -> Vec3:
    """Displacement (3,) m of the proxy in this tick since a contact pushes more or less than before."""
    return vec3.scale(contact.push - contact_on(before, contact.body).push, contact.normal)


@jit
def displaced_by_turning(before: ContactState, carried: ContactState) -> Vec3:
    """Displacement (3,) m of the proxy in this tick since the object under a contact turns."""
    return vec3.scale(before.push, vec3.sub(carried.normal, before.normal))


@jit
def shear_of(state: FingerState, last: Contacts, contacts: Contacts, motion: ProbeMotion) -> Shear:
    """Motion of the contacts; `last` are those of the last tick, carried along."""
    probe, before, _ = motion
    way = vec3.add(displaced_by_push(last, contacts[0]), displaced_by_push(last, contacts[1]))
    way = vec3.add(way, displaced_by_push(last, contacts[2]))
    one, two, three = state.contacts
    rode = vec3.add(displaced_by_turning(one, last[0]), displaced_by_turning(two, last[1]))
    rode = vec3.add(rode, displaced_by_turning(three, last[2]))
    return Shear(
        turn=rotations.relative(probe.orientation, before.orientation),
        free=vec3.add(vec3.add(vec3.sub(probe.position, before.position), way), rode),
        blocked=vec3.scale(-1.0, way),
        center=state.center,
    )


@jit
def lever_of(objects: Any, contact: ContactState, radius: float, center: Vec3) -> Lever:
    """Depth times the curvature of the surface that the proxy, at `center` (3,) m, moves on; within 1, or a probe at
    the middle of what it curves about would have no way."""
    k1, k2, along = curvature_of(objects, contact.body, radius, center, contact.normal)
    most = max(abs(k1), abs(k2)) * contact.push
    depth = contact.push / most if most > 1.0 else contact.push
    return Lever(depth * k1, depth * k2, along)


@jit
def levered(lever: Lever, normal: Vec3, v: Vec3) -> Vec3:
    """The tangent `v` (3,) at the proxy as it is at the probe: v - depth dn/dp v."""
    if lever.first == 0.0 and lever.second == 0.0:
        return v
    across = vec3.cross(normal, lever.along)
    v = vec3.add_scaled(v, -lever.first * vec3.dot(v, lever.along), lever.along)
    return vec3.add_scaled(v, -lever.second * vec3.dot(v, across), across)


@jit
def predict(
    method: Any, objects: Any, radius: float, center: Vec3, contact: ContactState, shear: Shear
) -> tuple[Prediction, float]:
    """A contact that sticks, and how far it rolls, rad: its deflection after what probe, object and fingertip did.

    e <- e - (dx - do) + (1 - d W) r theta (a x n), all of it in the tangent plane: x the probe, displaced by what
    pushes more or less than before, o the object at the probe, d the depth, W = dn/dp of the surface that the proxy
    moves on. A proxy that rolls by u takes the probe along by (1 - d W) u: then nothing is wound.
    Of the probe's way that the proxy was kept from, only what unwinds e counts: the hand gets no more work from
    the contact than its spring gives, whatever the others do meanwhile.
    """
    if contact.body < 0.0:
        return NO_PREDICTION, 0.0
    normal, carried = contact.normal, carry(objects, contact.body)
    rolled = roll_flat_on(method, objects, contact.body, radius, normal, relative_rotation(carried, shear.turn))
    rode = vec3.sub(carried_point(carried, shear.center), shear.center)
    way = vec3.reject(vec3.sub(shear.free, rode), normal)
    wound = levered(lever_of(objects, contact, radius, center), normal, rolled.motion)
    deflection = vec3.add(vec3.sub(contact.deflection, way), wound)
    blocked = vec3.reject(shear.blocked, normal)
    square = vec3.dot(blocked, blocked)
    if square > 0.0:
        share = min(max(vec3.dot(deflection, blocked) / square, 0.0), 1.0)
        deflection = vec3.add_scaled(deflection, -share, blocked)
    wound_part = replace(contact, "rolled_part", vec3.add(contact.rolled_part, wound))
    return Prediction(wound_part, deflection, rolled.spin, False), rolled.theta


@jit
def continue_several(
    scene: Scene, objects: Any, shapes: Any, radius: float, state: FingerState, motion: ProbeMotion
) -> Approach:
    """All contacts of the last tick go on, each with its object."""
    last = carried_contacts(shapes, state.contacts)
    center = carried_point(carry(shapes, last[0].body), state.center)
    base = vec3.add(motion.probe.position, lag_of(last))
    active = pushed_at(shapes, radius, base, center, constraints_of_contacts(last))
    contacts = hand_over(objects, last, active)
    shear = shear_of(state, last, contacts, motion)
    one, theta = predict(scene.rolling, shapes, radius, center, contacts[0], shear)
    two, _ = predict(scene.rolling, shapes, radius, center, contacts[1], shear)
    three, _ = predict(scene.rolling, shapes, radius, center, contacts[2], shear)
    return Approach(
        start=state.center,
        outside=center,
        center=center,
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
