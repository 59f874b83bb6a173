"""Poses of moving objects, as a function of time.

    pose_at(motion, pose, time) -> Pose       pose of the object; `pose` is its base pose

A motion is relative to the base pose: pose(t) = pose * motion(t), so a change of the base pose during a run moves the
path, too. Without a motion (None), and for an object driven from outside (Driven), the pose is the base pose; the
velocity of a driven object is unknown here. The pose of a Simulated object depends on its body, not on time.
"""

from math import cos, floor, pi, sin
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Driven, Object, Pose, Quaternion, Simulated, Sinusoid, Turntable, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of
from softfinger.proxy.kernels.query.bodies import last_pose_of_body, pose_of_body

TURNS_CEILING = 1e15
"""Number of turns beyond which float64 cannot represent a fraction of a turn."""


@by_type
def pose_at(motion: Any, pose: Pose, time: float) -> Any: ...


@jit
def angle_after(turns: float) -> float:
    """Return the angle in [0, 2 pi) of a number of turns; the sine of an unreduced angle would be inexact."""
    turns = min(max(turns, -TURNS_CEILING), TURNS_CEILING)
    return 2.0 * pi * (turns - floor(turns))


@jit
def turned(axis: Vec3, angle: float) -> Quaternion:
    """Return the rotation by `angle` rad about the unit vector `axis`."""
    s = sin(0.5 * angle)
    return (cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@jit
def carried(pose: Pose, position: Vec3, turn: Quaternion) -> Pose:
    """Return the pose in the world of a position (3,) m and a rotation in the frame `pose`."""
    moved = vec3.add(pose.position, rotations.rotate(pose.orientation, position))
    return Pose(moved, rotations.multiply(pose.orientation, turn))


@by_type
def moving_pose(motion: Any, pose: Any) -> Any:
    """Return the pose of an object that can move, None for one that cannot."""


@moving_pose.of(None)
def no_moving_pose(motion: None, pose: Any) -> None:
    return None


@moving_pose.otherwise
def own_pose(motion: Any, pose: Pose) -> Pose:
    return pose


@pose_at.of(None)
def pose_at_rest(motion: None, pose: Pose, time: float) -> Pose:
    return pose


@pose_at.of(Driven)
def pose_of_driven(motion: Driven, pose: Pose, time: float) -> Pose:
    """Return the base pose, which commands from outside set."""
    return pose


@pose_at.of(Sinusoid)
def pose_of_sinusoid(motion: Sinusoid, pose: Pose, time: float) -> Pose:
    """Translate by s A and rotate by s alpha about the axis through the origin, with s = sin(2 pi f t + phase)."""
    s = sin(angle_after(motion.frequency * time) + motion.phase)
    return carried(pose, vec3.scale(s, motion.translation), turned(motion.axis, s * motion.angle))


@pose_at.of(Turntable)
def pose_of_turntable(motion: Turntable, pose: Pose, time: float) -> Pose:
    """Rotate by rate * t about the axis through the pivot, the point of the object that does not move."""
    turn = turned(motion.axis, angle_after(motion.rate * time / (2.0 * pi)))
    return carried(pose, vec3.sub(motion.pivot, rotations.rotate(turn, motion.pivot)), turn)


@pose_at.of(Simulated)
def pose_of_simulated(motion: Simulated, pose: Pose, time: float) -> Pose:
    """Return the pose of an object attached to a body; its base pose is in the frame of the body."""
    return carried(pose_of_body(motion.block, motion.body), pose.position, pose.orientation)


@by_type
def in_row(motion: Any, body: Object) -> Any:
    """Return an object of a row with its poses of this tick and the last, which the World does not store for rows."""


@in_row.of(None)
def still_in_row(motion: None, body: Object) -> Object:
    return body


@in_row.of(Simulated)
def riding_in_row(motion: Simulated, body: Object) -> Object:
    rest = body.pose
    was = carried(last_pose_of_body(motion.block, motion.body), rest.position, rest.orientation)
    return replace(body, "pose", pose_of_simulated(motion, rest, 0.0), "was", was)


@by_type
def carried_along(was: Any, pose: Any, x: Vec3) -> Any:
    """Return the current position of a point that was at `x` (3,) m at the last tick and moved with the object."""


@carried_along.of(None)
def not_carried(was: None, pose: Any, x: Vec3) -> Vec3:
    return x


@carried_along.of(Pose)
def carried_by_pose(was: Pose, pose: Pose, x: Vec3) -> Vec3:
    return out_of(pose, into(was, x))
