"""All objects of a scene asked in turn, each where its pose puts it.

Objects are of different types, so they stand in a tuple and are asked one after the other by an
unrolled loop; `index` is an object's place in the tuple.
"""

from typing import Any

from numba import literal_unroll

from softfinger.proxy.kernels.dispatch import by_count
from softfinger.proxy.kernels.frames import into, out_of, pose_values, turn_into, turn_out_of
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Material, Object, Pose, Quaternion, Vec3
from softfinger.proxy.kernels.motion import pose_at
from softfinger.proxy.kernels.rolling import Roll, roll
from softfinger.proxy.kernels.surfaces import closest, transport


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
def transport_on(objects: Any, index: float, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """`transport` on the object with that place in the tuple; directions are the world's."""
    found = v
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            found = transport(body.shape, v, normal_from, normal_to)
        at += 1.0
    return found


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
