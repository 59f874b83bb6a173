"""Objects that move by themselves: their pose, in closed form of the time.

    pose_at(motion, pose, time) -> Pose       where the object is; `pose` is where it rests

A motion is given in the object's own frame at rest: pose(t) = pose * motion(t). Changing the pose of
rest while running carries the motion along. Without a motion (None), and for an object driven from
outside, the pose is the one at rest; the rate of a driven object is known to its driver only.
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
"""Past this many turns float64 has no fraction of a turn left."""


@by_type
def pose_at(motion: Any, pose: Pose, time: float) -> Any: ...


@jit
def angle_after(turns: float) -> float:
    """Angle in [0, 2 pi) of so many turns; whole ones are dropped first, lest the sine lose them."""
    turns = min(max(turns, -TURNS_CEILING), TURNS_CEILING)
    return 2.0 * pi * (turns - floor(turns))


@jit
def turned(axis: Vec3, angle: float) -> Quaternion:
    """Rotation by `angle` rad about the unit vector `axis`."""
    s = sin(0.5 * angle)
    return (cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@jit
def carried(pose: Pose, position: Vec3, turn: Quaternion) -> Pose:
    """Pose in the world of what has a position (3,) m and rotation in the frame `pose`."""
    moved = vec3.add(pose.position, rotations.rotate(pose.orientation, position))
    return Pose(moved, rotations.multiply(pose.orientation, turn))


@by_type
def moving_pose(motion: Any, pose: Any) -> Any:
    """Pose of an object that can move, None of one that cannot."""


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
    """The pose of rest is set anew by whoever drives it."""
    return pose


@pose_at.of(Sinusoid)
def pose_of_sinusoid(motion: Sinusoid, pose: Pose, time: float) -> Pose:
    """To and fro by s = sin(2 pi f t + phase): s A along, s alpha about the axis through the origin."""
    s = sin(angle_after(motion.frequency * time) + motion.phase)
    return carried(pose, vec3.scale(s, motion.translation), turned(motion.axis, s * motion.angle))


@pose_at.of(Turntable)
def pose_of_turntable(motion: Turntable, pose: Pose, time: float) -> Pose:
    """Turned by rate * t about the axis through the pivot, a point of the object that stays."""
    turn = turned(motion.axis, angle_after(motion.rate * time / (2.0 * pi)))
    return carried(pose, vec3.sub(motion.pivot, rotations.rotate(turn, motion.pivot)), turn)


@pose_at.of(Simulated)
def pose_of_simulated(motion: Simulated, pose: Pose, time: float) -> Pose:
    """The pose of rest is that in the body's frame."""
    return carried(pose_of_body(motion.block, motion.body), pose.position, pose.orientation)


@by_type
def in_row(motion: Any, body: Object) -> Any:
    """An object of a row, which the World has no place for, where it is now and was at the last tick."""


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
    """Where a point `x` (3,) m of the last tick is now, had it ridden on the object."""


@carried_along.of(None)
def not_carried(was: None, pose: Any, x: Vec3) -> Vec3:
    return x


@carried_along.of(Pose)
def carried_by_pose(was: Pose, pose: Pose, x: Vec3) -> Vec3:
    return out_of(pose, into(was, x))
