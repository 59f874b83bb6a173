"""Poses of moving objects, as a function of time.

    compute_pose(motion, pose, time) -> Pose       pose of the object; `pose` is its base pose

A motion is relative to the base pose: pose(t) = pose * motion(t), so a change of the base pose during a run moves the
path, too. Without a motion (None), and for an object driven from outside, the pose is the base pose; the velocity of a
driven object is unknown here. The pose of a simulated object depends on its body, not on time.
"""

from math import cos, pi, sin
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import SIMULATED, SINUSOID, STILL, TURNTABLE, Pose, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.scalars import fraction
from softfinger.proxy.kernels.query.bodies import POSITION, read_body_pose


@jit
def make_rotation(axis: Vec3, angle: float) -> Quaternion:
    """Return the rotation by `angle` rad about the unit vector `axis`."""
    s = sin(0.5 * angle)
    return (cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@jit
def compose_pose(pose: Pose, position: Vec3, turn: Quaternion) -> Pose:
    """Return the pose in the world of a position (3,) m and a rotation in the frame `pose`."""
    moved = vec3.add(pose.position, rotations.rotate(pose.orientation, position))
    return Pose(moved, rotations.multiply(pose.orientation, turn))


@jit
def compute_pose(motion: Any, pose: Any, time: float) -> Any:
    if motion is None:
        return pose
    if motion.kind == SINUSOID:
        # The sine of an unreduced angle would be inexact.
        s = sin(2.0 * pi * fraction(motion.frequency * time) + motion.phase)
        return compose_pose(pose, vec3.scale(s, motion.translation), make_rotation(motion.axis, s * motion.angle))
    if motion.kind == TURNTABLE:  # the pivot is the point of the object that does not move
        turn = make_rotation(motion.axis, 2.0 * pi * fraction(motion.rate * time / (2.0 * pi)))
        return compose_pose(pose, vec3.sub(motion.pivot, rotations.rotate(turn, motion.pivot)), turn)
    if motion.kind == SIMULATED:  # the base pose is in the frame of the body
        return compose_pose(read_body_pose(motion.block, motion.body, POSITION), pose.position, pose.orientation)
    return pose


@jit
def select_moving_pose(motion: Any, pose: Any) -> Any:
    """Return the pose of an object that can move, None for one that cannot.

    Of many objects, a fixed one has the identity: its base pose is applied elsewhere, as for a single object.
    """
    if motion is None:
        return None
    return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) if motion.kind == STILL else pose


@jit
def can_move(motion: Any) -> float:
    """Return 1 for a motion that can change an object's pose, else 0."""
    return 0.0 if motion is None or motion.kind == STILL else 1.0
