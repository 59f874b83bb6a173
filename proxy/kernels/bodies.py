"""Objects in the world: every shape where its pose puts it, and all objects of a scene asked in turn.

Shapes know their own frame only. A pose is None (the shape is given in the world), a Place (moved) or
a Pose (moved and turned). Objects of a scene are of different types, so they stand in a tuple and are
asked one after the other by an unrolled loop.
"""

from typing import Any, NamedTuple

from numba import literal_unroll

from softfinger.proxy.kernels import rotations, vec3
from softfinger.proxy.kernels.dispatch import by_count, by_type
from softfinger.proxy.kernels.effects import Moment, apply_effects
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import (
    Box,
    CappedCylinder,
    Capsule,
    Cylinder,
    Driven,
    Ellipsoid,
    Material,
    Object,
    Place,
    Plane,
    Pose,
    Quaternion,
    Sinusoid,
    Sphere,
    Torus,
    Turntable,
    Vec3,
)
from softfinger.proxy.kernels.motion import pose_at
from softfinger.proxy.kernels.rolling import Roll, roll
from softfinger.proxy.kernels.surfaces import closest, transport

NO_HIT = 2.0
"""Share of the way that says: nothing was met on it."""
ADVANCES = 32
"""Steps of a sweep; each goes as far as the clearance allows, so most sweeps take one or two."""
TOUCHING = 1e-9
"""Clearance, as a share of the radius, that counts as none."""


@by_type
def into(pose: Any, x: Vec3) -> Any:
    """World point to the object's frame."""


@by_type
def out_of(pose: Any, x: Vec3) -> Any:
    """Point of the object's frame to the world."""


@by_type
def turn_into(pose: Any, v: Vec3) -> Any:
    """World direction to the object's frame."""


@by_type
def turn_out_of(pose: Any, v: Vec3) -> Any:
    """Direction of the object's frame to the world."""


@into.of(None)
def into_world(pose: None, x: Vec3) -> Vec3:
    return x


@out_of.of(None)
def out_of_world(pose: None, x: Vec3) -> Vec3:
    return x


@turn_into.of(None)
def turn_into_world(pose: None, v: Vec3) -> Vec3:
    return v


@turn_out_of.of(None)
def turn_out_of_world(pose: None, v: Vec3) -> Vec3:
    return v


@into.of(Place)
def into_place(pose: Place, x: Vec3) -> Vec3:
    return vec3.sub(x, pose.position)


@out_of.of(Place)
def out_of_place(pose: Place, x: Vec3) -> Vec3:
    return vec3.add(x, pose.position)


@turn_into.of(Place)
def turn_into_place(pose: Place, v: Vec3) -> Vec3:
    return v


@turn_out_of.of(Place)
def turn_out_of_place(pose: Place, v: Vec3) -> Vec3:
    return v


@into.of(Pose)
def into_pose(pose: Pose, x: Vec3) -> Vec3:
    return rotations.rotate(rotations.conjugate(pose.orientation), vec3.sub(x, pose.position))


@out_of.of(Pose)
def out_of_pose(pose: Pose, x: Vec3) -> Vec3:
    return vec3.add(rotations.rotate(pose.orientation, x), pose.position)


@turn_into.of(Pose)
def turn_into_pose(pose: Pose, v: Vec3) -> Vec3:
    return rotations.rotate(rotations.conjugate(pose.orientation), v)


@turn_out_of.of(Pose)
def turn_out_of_pose(pose: Pose, v: Vec3) -> Vec3:
    return rotations.rotate(pose.orientation, v)


@jit
def closest_on(body: Any, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """`closest` of one object in the world."""
    gap, point, normal = closest(body.shape, into(body.pose, x))
    return gap, out_of(body.pose, point), turn_out_of(body.pose, normal)


@jit
def closest_to(objects: Any, index: float, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """`closest` of the object with that place in the tuple."""
    gap, point, normal = 0.0, x, (0.0, 0.0, 1.0)
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            gap, point, normal = closest_on(body, x)
        at += 1.0
    return gap, point, normal


@jit
def material_of(objects: Any, index: float) -> Material:
    """Material of the object with that place in the tuple; all have the same parts."""
    found = objects[0].material
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            found = body.material
        at += 1.0
    return found


@jit
def number_of(objects: Any, index: float) -> float:
    """Number in the scene file of the object with that place in the tuple, -1 for none; several may make one object."""
    found = -1.0
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            found = body.number
        at += 1.0
    return found


@jit
def roll_on(
    method: Any, objects: Any, index: float, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> Roll:
    """`roll` over the object with that place in the tuple, in the world."""
    found = Roll(center, normal, (0.0, 0.0, 0.0), 0.0, 0.0)
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            pose = body.pose
            axis = turn_into(pose, (turn[1], turn[2], turn[3]))
            local = roll(
                method,
                body.shape,
                radius,
                into(pose, center),
                turn_into(pose, normal),
                (turn[0], axis[0], axis[1], axis[2]),
            )
            found = Roll(
                out_of(pose, local.center),
                turn_out_of(pose, local.normal),
                turn_out_of(pose, local.motion),
                local.theta,
                local.spin,
            )
        at += 1.0
    return found


class Carry(NamedTuple):
    """How an object moved since the last tick; `moves` is 0 for one that cannot."""

    moves: float
    was: Pose
    now: Pose


@by_type
def can_move(motion: Any) -> Any:
    """1 for a motion that can change an object's pose."""


@can_move.of(None)
def cannot_move(motion: None) -> float:
    return 0.0


def moves(motion: Any) -> float:
    return 1.0


for _motion in (Sinusoid, Turntable, Driven):
    can_move.of(_motion)(moves)


@by_type
def pose_values(pose: Any) -> Any:
    """Any pose as a Pose."""


@pose_values.of(None)
def pose_of_world(pose: None) -> Pose:
    return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@pose_values.of(Place)
def pose_of_place(pose: Place) -> Pose:
    return Pose(pose.position, (1.0, 0.0, 0.0, 0.0))


@pose_values.of(Pose)
def pose_of_pose(pose: Pose) -> Pose:
    return pose


@jit
def pose_of(objects: Any, index: float) -> Pose:
    """Pose of the object with that place in the tuple."""
    found = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            found = pose_values(body.pose)
        at += 1.0
    return found


@jit
def carry(objects: Any, index: float, was: Pose) -> Carry:
    """Motion of the object with that place in the tuple since it had the pose `was`."""
    moves, now = 0.0, was
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            moves, now = can_move(body.motion), pose_values(body.pose)
        at += 1.0
    return Carry(moves, was, now)


@jit
def carried_point(carried: Carry, x: Vec3) -> Vec3:
    """A point of the object, (3,) m world, where it is now."""
    if carried.moves == 0.0:
        return x
    return out_of_pose(carried.now, into_pose(carried.was, x))


@jit
def carried_direction(carried: Carry, v: Vec3) -> Vec3:
    """A direction of the object, world, as it points now."""
    if carried.moves == 0.0:
        return v
    return turn_out_of_pose(carried.now, turn_into_pose(carried.was, v))


@jit
def turn_against(carried: Carry, turn: Quaternion) -> Quaternion:
    """The fingertip's rotation `turn` less the object's own, w >= 0: what it turned against the object."""
    if carried.moves == 0.0:
        return turn
    objects_turn = rotations.relative(carried.now.orientation, carried.was.orientation)
    return rotations.relative(turn, objects_turn)


@jit
def transport_on(objects: Any, index: float, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """`transport` on the object with that place in the tuple; directions are the world's."""
    found = v
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            found = transport(body.shape, v, normal_from, normal_to)
        at += 1.0
    return found


@by_type
def travel(shape: Any, start: Vec3, end: Vec3, radius: float) -> Any:
    """Share of the way from start to end (local points) at which a sphere of that radius meets the shape."""


@travel.of(Plane)
def travel_to_plane(shape: Plane, start: Vec3, end: Vec3, radius: float) -> float:
    before = vec3.dot(shape.normal, start) - shape.offset - radius
    after = vec3.dot(shape.normal, end) - shape.offset - radius
    if after >= 0.0 or after >= before:
        return NO_HIT
    return max(before, 0.0) / (max(before, 0.0) - after)


def travel_to_shape(shape: Any, start: Vec3, end: Vec3, radius: float) -> float:
    """Conservative advancement: go as far as the clearance, which nothing can be nearer than; ask again."""
    way = vec3.sub(end, start)
    length = vec3.norm(way)
    gap, _, _ = closest(shape, start)
    clearance = gap - radius
    if clearance >= length:
        return NO_HIT
    touching = TOUCHING * radius
    if clearance <= touching:
        gap, _, _ = closest(shape, end)
        return 0.0 if gap - radius < min(clearance, 0.0) else NO_HIT
    share = 0.0
    for _ in range(ADVANCES):
        share += clearance / length
        if share >= 1.0:
            return NO_HIT
        gap, _, _ = closest(shape, vec3.add_scaled(start, share, way))
        clearance = gap - radius
        if clearance <= touching:
            return share
    # A glancing pass comes ever closer without meeting: it counts only if it ends inside.
    gap, _, _ = closest(shape, end)
    return share if gap < radius else NO_HIT


for _kind in (Sphere, Cylinder, CappedCylinder, Capsule, Box, Ellipsoid, Torus):
    travel.of(_kind)(travel_to_shape)


@jit
def first_hit(objects: Any, start: Vec3, end: Vec3, radius: float, skip: Any) -> tuple[float, float]:
    """Share of the way at which the first object is met, and its place in the tuple; NO_HIT and -1 for none.

    `skip` are the places of up to three objects that are not asked.
    """
    share, index = NO_HIT, -1.0
    at = 0.0
    for body in literal_unroll(objects):
        if at != skip[0] and at != skip[1] and at != skip[2]:
            met = travel(body.shape, into(body.pose, start), into(body.pose, end), radius)
            if met < share:
                share, index = met, at
        at += 1.0
    return share, index


@jit
def deepest(objects: Any, x: Vec3) -> tuple[float, float]:
    """Smallest gap of `x` over all objects, and that object's place in the tuple."""
    smallest, index = 1e300, -1.0
    at = 0.0
    for body in literal_unroll(objects):
        gap, _, _ = closest(body.shape, into(body.pose, x))
        if gap < smallest:
            smallest, index = gap, at
        at += 1.0
    return smallest, index


@jit
def place(body: Any, time: float) -> Any:
    """The object where its motion has brought it at `time` (s)."""
    pose = pose_at(body.motion, body.pose, time)
    return Object(body.shape, pose, body.motion, body.material, body.number, body.effects)


@by_count
def place_all(objects: Any, time: float) -> Any:
    """All objects where their motions have brought them at `time` (s)."""


@place_all.of(1)
def place_one(objects: Any, time: float) -> Any:
    return (place(objects[0], time),)


@place_all.of(2)
def place_several(objects: Any, time: float) -> Any:
    # numba joins tuples of known types, and does not unpack one inside another.
    return (place(objects[0], time),) + place_all(objects[1:], time)  # noqa: RUF005


class Touched(NamedTuple):
    """Numbers of the up to three objects that hold the proxy, -1 for none, and the normals there."""

    first: float
    second: float
    third: float
    n1: Vec3
    n2: Vec3
    n3: Vec3


@by_count
def apply_objects_effects(objects: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    """Sum of the forces (3,) N of all objects' effects, and their states."""


@apply_objects_effects.of(1)
def effects_of_one(objects: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    force, state = effects_of(objects[0].effects, objects[0], states[0], radius, touched, contact)
    return force, (state,)


@apply_objects_effects.of(2)
def effects_of_several(objects: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    force, state = effects_of(objects[0].effects, objects[0], states[0], radius, touched, contact)
    others, rest = apply_objects_effects(objects[1:], states[1:], radius, touched, contact)
    return vec3.add(force, others), (state,) + rest  # noqa: RUF005  # see place_several


@by_count
def effects_of(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    """Force and states of one object's effects."""


@effects_of.of(0)
def effects_of_none(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    return (-0.0, -0.0, -0.0), ()  # see effects.apply_none


def effects_of_some(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    gap, _, normal = closest_on(body, contact.position)
    is_touched = 1.0
    # The contact's normal, not that of the nearest surface point: the probe may be through a thin body.
    if body.number == touched.first:
        normal = touched.n1
    elif body.number == touched.second:
        normal = touched.n2
    elif body.number == touched.third:
        normal = touched.n3
    else:
        is_touched = 0.0
    carrier = carrier_of(body.motion, body.pose)
    moment = Moment(contact.position, contact.velocity, contact.dt, is_touched, gap - radius, normal, carrier)
    return apply_effects(effects, states, moment)


effects_of.of(1)(effects_of_some)
effects_of.of(2)(effects_of_some)


@by_type
def carrier_of(motion: Any, pose: Any) -> Any:
    """Pose of an object that moves, None for one that stands still."""


@carrier_of.of(None)
def no_carrier(motion: None, pose: Any) -> None:
    return None


def own_pose(motion: Any, pose: Pose) -> Pose:
    return pose


for _motion in (Sinusoid, Turntable, Driven):
    carrier_of.of(_motion)(own_pose)
