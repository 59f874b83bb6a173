"""Contacts with several objects at once: carried from tick to tick, rolled and sheared.

The deflection e of a contact follows the motion of the proxy without friction y, which is the probe's where nothing is
in the way, and is as it was where the probe only presses deeper into another wall: the skin rests there.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import (
    carried_direction,
    carried_point,
    carry,
    relative_rotation,
    relative_velocity,
)
from softfinger.proxy.kernels.contact.fingertip import velocity_at
from softfinger.proxy.kernels.contact.hand_over import Contacts, contact_on
from softfinger.proxy.kernels.contact.normal import normal_force_of
from softfinger.proxy.kernels.contact.rest.among import relax
from softfinger.proxy.kernels.contact.rest.cutting_planes import held_at_anchor
from softfinger.proxy.kernels.contact.rolling.on_objects import roll_flat_on
from softfinger.proxy.kernels.contact.texture import texture_depth_on
from softfinger.proxy.kernels.friction.stick_slip import split
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    ActiveSet,
    Constraint,
    ContactState,
    FingerState,
    FrictionInput,
    Probe,
    Quaternion,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.kinds import any_creases, any_mesh
from softfinger.proxy.kernels.query.objects import curvature_of, normal_law_of

EDGE = 1.0 - 1e-6
"""Curvature of the surface that the proxy moves on, times the fingertip's radius, from which on an edge is under it."""


class Motion(NamedTuple):
    """What moves all contacts in a tick.

    radius          m     of the fingertip
    form                  None or EllipsoidTip
    resolution      m     encoder step of the probe
    dt              s     time step
    probe                 now
    last                  the probe at the last tick
    center   (3,)   m     the proxy at the last tick
    turn                  rotation of the fingertip since the last tick
    free     (3,)   m     way of the probe, displaced by what pushes more or less than before
    blocked  (3,)   m     way of the probe that the proxy was kept from
    farther  (3,)   m     how much farther the proxy went over edges
    touches               a first touch, whose contacts stick where it is now: nothing has moved them
    """

    radius: float
    form: Any
    resolution: float
    dt: float
    probe: Probe
    last: Probe
    center: Vec3
    turn: Quaternion
    free: Vec3
    blocked: Vec3
    farther: Vec3
    touches: bool


class Lever(NamedTuple):
    """How the probe's way over an object is shorter than the proxy's, since the normal turns: by the shares `first`
    along the unit tangent `along` (3,), and `second` across it. Where a surface bends, in a hollow it is longer."""

    first: float
    second: float
    along: Vec3


class Load(NamedTuple):
    """How hard one object presses on the hand: N, and along which unit vector (3,)."""

    size: float
    along: Vec3


@jit
def warm_start(objects: Any, radius: float, state: FingerState, probe: Vec3) -> tuple[Vec3, ActiveSet]:
    """The proxy (3,) m of the last tick as its first object carried it, and what held it, pushing as it does now."""
    one, two, three = state.contacts
    center = carried_point(carry(objects, one.body), state.center)
    if any_mesh(objects) and not any_creases(objects):
        return center, held_at_anchor(objects, radius, probe, center, (one.body, two.body, three.body))
    up = one.normal
    active = (Constraint(one.body, up, 0.0), Constraint(two.body, up, 0.0), Constraint(three.body, up, 0.0))
    _, active = relax(objects, radius, probe, center, active, 1)
    return center, active


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
def displaced_by_object(before: Contacts, contact: ContactState) -> Vec3:
    """How far (3,) m the object under a contact pushes the proxy beside the way of the probe in this tick."""
    return vec3.scale(contact.push - contact_on(before, contact.body).push, contact.normal)


@jit
def displaced_by_release(contacts: Contacts, contact: ContactState) -> Vec3:
    """How far (3,) m the proxy comes back because an object has let go of it; 0 where it holds it still."""
    return vec3.scale(-contact.push if contact_on(contacts, contact.body).body < 0.0 else 0.0, contact.normal)


@jit
def displaced_by_friction(before: Contacts, contacts: Contacts) -> Vec3:
    """What (3,) m the proxy's way in this tick is beside the probe's."""
    way = vec3.add(displaced_by_object(before, contacts[0]), displaced_by_release(contacts, before[0]))
    way = vec3.add(way, vec3.add(displaced_by_object(before, contacts[1]), displaced_by_release(contacts, before[1])))
    return vec3.add(way, vec3.add(displaced_by_object(before, contacts[2]), displaced_by_release(contacts, before[2])))


@jit
def displaced_by_turning_objects(before: Contacts, carried: Contacts) -> Vec3:
    """How far (3,) m the proxy goes beside the probe because objects turn, and their normals with them: contacts of the
    last tick as they were, and carried along."""
    way = vec3.scale(before[0].push, vec3.sub(carried[0].normal, before[0].normal))
    way = vec3.add_scaled(way, before[1].push, vec3.sub(carried[1].normal, before[1].normal))
    return vec3.add_scaled(way, before[2].push, vec3.sub(carried[2].normal, before[2].normal))


@jit
def lever_of(objects: Any, contact: ContactState, radius: float, center: Vec3) -> Lever:
    """Depth times the curvature of the surface that the proxy, at `center` (3,) m, moves on; within 1, or a probe at
    the middle of what it curves about would have no way. None over an edge, of a box as of triangles."""
    if contact.body < 0.0:
        return Lever(0.0, 0.0, contact.normal)
    k1, k2, along = curvature_of(objects, contact.body, radius, center, contact.normal)
    flat = k1 == 0.0 and k2 == 0.0  # known when a scene of flat objects is compiled
    if flat or max(k1, k2) * radius > EDGE:
        return Lever(0.0, 0.0, along)
    most = max(abs(k1), abs(k2)) * contact.push
    depth = contact.push / most if most > 1.0 else contact.push
    return Lever(depth * k1, depth * k2, along)


@jit
def levers_of(objects: Any, contacts: Contacts, radius: float, center: Vec3) -> tuple[Lever, Lever, Lever]:
    """`lever_of` of each contact."""
    return (
        lever_of(objects, contacts[0], radius, center),
        lever_of(objects, contacts[1], radius, center),
        lever_of(objects, contacts[2], radius, center),
    )


@jit
def levered(lever: Lever, normal: Vec3, v: Vec3) -> Vec3:
    """The tangent `v` (3,) at the proxy as it is at the probe: v - depth dn/dp v."""
    if lever.first == 0.0 and lever.second == 0.0:
        return v
    across = vec3.cross(normal, lever.along)
    v = vec3.add_scaled(v, -lever.first * vec3.dot(v, lever.along), lever.along)
    return vec3.add_scaled(v, -lever.second * vec3.dot(v, across), across)


@jit
def displaced_by_turning_normal(before: Contacts, contact: ContactState, lever: Lever) -> Vec3:
    """How far (3,) m the proxy goes because the normal under a contact turned against its object in this tick, over an
    edge; where the surface bends it has a lever."""
    if lever.first != 0.0 or lever.second != 0.0:
        return (0.0, 0.0, 0.0)
    was = contact_on(before, contact.body)
    return vec3.scale(was.push, vec3.sub(contact.normal, was.normal))


@jit
def farther_than_probe(before: Contacts, contacts: Contacts, levers: tuple[Lever, Lever, Lever]) -> Vec3:
    """How much farther (3,) m than the probe, which is deeper, the proxy goes over edges."""
    way = displaced_by_turning_normal(before, contacts[0], levers[0])
    way = vec3.add(way, displaced_by_turning_normal(before, contacts[1], levers[1]))
    return vec3.add(way, displaced_by_turning_normal(before, contacts[2], levers[2]))


@jit
def load_on(objects: Any, contact: ContactState, motion: Motion) -> Load:
    carried, since = carry(objects, contact.body), 0.0 if motion.touches else motion.dt
    velocity = relative_velocity(carried, motion.probe.velocity, motion.last.position, motion.dt)
    velocity = velocity_at(motion.form, velocity, carried, motion.probe, motion.last, contact.normal, since)
    depth, m = texture_depth_on(objects, contact.body, contact.push, contact.normal, motion.probe.position)
    return Load(normal_force_of(normal_law_of(objects, contact.body), depth, vec3.dot(velocity, m)), m)


@jit
def shear(
    method: Any, objects: Any, contact: ContactState, lever: Lever, motion: Motion, normal_force: float, unit: float
) -> tuple[FrictionInput, float]:
    """A contact that sticks, as friction is to see it, and how far it rolled, rad: its deflection after what proxy,
    object and fingertip did in this tick. `unit` is that of its wind-up.

    e <- e - (dx - do) + (1 - d W) r theta (a x n), all of it in the tangent plane: x the probe, displaced by what
    pushes more or less than before, o the object at the probe, d the depth, W = dn/dp of the surface that the proxy
    moves on. A proxy that rolls by u takes the probe along by (1 - d W) u: then nothing is wound. The force has the
    lever (1 - d W) r about the fingertip's centre, so what it stores is what finger and object give, to and fro.
    Of the probe's way that the proxy was kept from, only what unwinds e counts: the hand gets no more work from
    the contact than its spring gives, whatever the others do meanwhile. And where the proxy goes farther than the
    probe over an edge, its way takes back what a roll has wound.
    """
    normal, carried = contact.normal, carry(objects, contact.body)
    deflection, rolled_part, theta, twist = contact.deflection, contact.rolled_part, 0.0, 0.0
    if not motion.touches:
        turn = relative_rotation(carried, motion.turn)
        rolled = roll_flat_on(method, objects, contact.body, motion.radius, normal, turn)
        rode = vec3.sub(carried_point(carried, motion.center), motion.center)
        way = vec3.reject(vec3.sub(motion.free, rode), normal)
        wound = levered(lever, normal, rolled.motion)
        deflection = vec3.add(vec3.sub(deflection, way), wound)
        rolled_part, theta, twist = vec3.add(rolled_part, wound), rolled.theta, rolled.spin
        blocked = vec3.reject(motion.blocked, normal)
        square = vec3.dot(blocked, blocked)
        if square > 0.0:
            share = min(max(vec3.dot(deflection, blocked) / square, 0.0), 1.0)
            deflection = vec3.add_scaled(deflection, -share, blocked)
        swing = vec3.reject(motion.farther, normal)
        square = vec3.dot(swing, swing)
        if square > 0.0:
            _, by_roll = split(deflection, rolled_part)
            share = min(max(min(vec3.dot(by_roll, swing), vec3.dot(deflection, swing)) / square, 0.0), 1.0)
            deflection = vec3.add_scaled(deflection, -share, swing)
    seen = FrictionInput(
        radius=motion.radius,
        resolution=motion.resolution,
        dt=motion.dt,
        mode=contact.mode,
        normal=normal,
        deflection=deflection,
        deflection_before=contact.deflection,
        rolled_part=rolled_part,
        slip_speed=contact.slip_speed,
        slip_deflection=contact.slip_deflection,
        spin=contact.spin / unit,
        twist=twist,
        spin_slip_speed=contact.spin_slip_speed,
        spin_slip_angle=contact.spin_slip_angle / unit,
        normal_force=normal_force,
    )
    return seen, theta
