"""All objects of a scene asked in turn, each where its pose puts it.

Objects are of different types, so they stand in a tuple and are asked one after the other by an
unrolled loop. Many of one type stand together in it as `Rows`; `index` is an object's place: see
`entries`.
"""

from typing import Any

from numba import literal_unroll

from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll, roll
from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.geometry.entries import has, member, places
from softfinger.proxy.kernels.geometry.frames import into, out_of, pose_values, turn_into, turn_out_of
from softfinger.proxy.kernels.geometry.surfaces import bend, closest, follows, is_hollow, tangent_plane, transport
from softfinger.proxy.kernels.model import Material, Pose, Quaternion, Vec3
from softfinger.proxy.kernels.native.dispatch import by_type
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.rows import Rows

SWING = 0.2
"""Turn of the contact round a hollow in a tick, rad, past which it slides: no hand follows it thirty times a second."""


@jit
def closest_on(body: Any, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """`closest` of one object in the world."""
    gap, point, normal = closest(body.shape, into(body.pose, x))
    return gap, out_of(body.pose, point), turn_out_of(body.pose, normal)


@jit
def closest_to(objects: Any, index: float, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """`closest` of the object with that place."""
    gap, point, normal = 0.0, x, (0.0, 0.0, 1.0)
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            gap, point, normal = closest_on(body, x)
        at += places(entry)
    return gap, point, normal


@jit
def material_of(objects: Any, index: float) -> Material:
    """Material of the object with that place; all have the same parts."""
    found = member(objects[0], 0.0).material
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = body.material
        at += places(entry)
    return found


@jit
def number_of(objects: Any, index: float) -> float:
    """Number in the scene file of the object with that place, -1 for none; several may make one object."""
    found = -1.0
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = body.number
        at += places(entry)
    return found


@jit
def roll_on(
    method: Any, objects: Any, index: float, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> Roll:
    """`roll` over the object with that place, in the world."""
    found = Roll(center, normal, (0.0, 0.0, 0.0), 0.0, 0.0)
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
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
        at += places(entry)
    return found


@jit
def roll_flat_on(method: Any, objects: Any, index: float, radius: float, normal: Vec3, turn: Quaternion) -> Roll:
    """`roll` in the tangent plane of the object with that place; of the Roll, `motion` and the angles."""
    found = Roll(normal, normal, (0.0, 0.0, 0.0), 0.0, 0.0)
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            pose = body.pose
            n, axis = turn_into(pose, normal), turn_into(pose, (turn[1], turn[2], turn[3]))
            turned = (turn[0], axis[0], axis[1], axis[2])
            local = roll(method, tangent_plane(body.shape, n), radius, vec3.scale(radius, n), n, turned)
            found = Roll(normal, normal, turn_out_of(pose, local.motion), local.theta, local.spin)
        at += places(entry)
    return found


@jit
def is_inside(objects: Any, index: float) -> bool:
    """Whether the object with that place is touched from inside."""
    inside = False
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            inside = is_hollow(body.shape)
        at += places(entry)
    return inside


@jit
def swings_on(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3, theta: float) -> bool:
    """Whether a roll by `theta` rad takes the contact round a hollow so far that its way cannot be followed.

    The contact turns by k r theta, k the curvature of the surface that the centre moves on: any number of times the
    roll in a hollow that the fingertip nearly fills.
    """
    swings = False
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            point = into(body.pose, vec3.add_scaled(center, -radius, normal))
            swings = bend(body.shape, radius, point, turn_into(body.pose, normal)) * radius * theta > SWING
        at += places(entry)
    return swings


@jit
def follows_on(objects: Any, index: float, radius: float, start: OffsetPoint, end: Vec3) -> bool:
    """`follows` of the object with that place, in the world."""
    leads = True
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            begun = into(body.pose, start.center)
            leads = follows(body.shape, radius, begun, turn_into(body.pose, start.normal), into(body.pose, end))
        at += places(entry)
    return leads


@jit
def pose_of(objects: Any, index: float) -> Pose:
    """Pose of the object with that place."""
    found = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = pose_values(body.pose)
        at += places(entry)
    return found


@jit
def transport_on(objects: Any, index: float, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """`transport` on the object with that place; directions are the world's."""
    found = v
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = transport(body.shape, v, normal_from, normal_to)
        at += places(entry)
    return found


@by_type
def nearest_in(entry: Any, x: Vec3) -> Any:
    """Smallest gap of `x` over the objects of an entry, and that object's number in it."""


@nearest_in.otherwise
def gap_of_it(entry: Any, x: Vec3) -> tuple[float, float]:
    gap, _, _ = closest(entry.shape, into(entry.pose, x))
    return gap, 0.0


@nearest_in.of(Rows)
def smallest_gap_in_rows(entry: Any, x: Vec3) -> tuple[float, float]:
    smallest, number = 1e300, 0.0
    for i in range(len(entry)):
        body = entry[i]
        gap, _, _ = closest(body.shape, into(body.pose, x))
        if gap < smallest:
            smallest, number = gap, float(i)
    return smallest, number


@jit
def deepest(objects: Any, x: Vec3) -> tuple[float, float]:
    """Smallest gap of `x` over all objects, and that object's place."""
    smallest, index = 1e300, -1.0
    at = 0.0
    for entry in literal_unroll(objects):
        gap, number = nearest_in(entry, x)
        if gap < smallest:
            smallest, index = gap, at + number
        at += places(entry)
    return smallest, index
