"""Rolling over an object in the world frame: the rolling methods work in the frame of the object."""

from typing import Any

from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll, roll
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Plane, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of, turn_into, turn_out_of
from softfinger.proxy.kernels.query.container import find_object, find_world_plane
from softfinger.proxy.kernels.shapes import follows


@jit
def roll_on(method: Any, body: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """Return `roll` over an object, in the world frame."""
    pose = body.pose
    axis = turn_into(pose, (turn[1], turn[2], turn[3]))
    turned = (turn[0], axis[0], axis[1], axis[2])
    local = roll(method, body.shape, radius, into(pose, center), turn_into(pose, normal), turned)
    return Roll(
        out_of(pose, local.center),
        turn_out_of(pose, local.normal),
        turn_out_of(pose, local.motion),
        local.theta,
        local.spin,
        local.is_complete,
    )


@jit
def roll_flat_on(method: Any, objects: Any, index: float, radius: float, normal: Vec3, turn: Quaternion) -> Roll:
    """Return `roll` in the tangent plane of object `index`; only `motion` and the angles of the Roll are valid."""
    pose, n, axis = find_object(objects, index).pose, normal, (turn[1], turn[2], turn[3])
    is_plane, _ = find_world_plane(objects, index)
    if not is_plane:
        n, axis = turn_into(pose, n), turn_into(pose, axis)
    turned = (turn[0], axis[0], axis[1], axis[2])
    local = roll(method, Plane(n, 0.0), radius, vec3.scale(radius, n), n, turned)
    motion = local.motion if is_plane else turn_out_of(pose, local.motion)
    return Roll(normal, normal, motion, local.theta, local.spin, True)


@jit
def can_follow(body: Any, radius: float, start: OffsetPoint, end: Vec3) -> bool:
    """Return `follows` of an object, in the world frame."""
    origin = into(body.pose, start.center)
    return follows(body.shape, radius, origin, turn_into(body.pose, start.normal), into(body.pose, end))
