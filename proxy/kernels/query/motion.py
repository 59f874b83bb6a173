"""Poses of moving objects, as a function of time.

    pose_at(motion, pose, time) -> Pose       pose of the object; `pose` is its base pose

A motion is relative to the base pose: pose(t) = pose * motion(t), so a change of the base pose during a run moves the
path, too. Without a motion (None), and for an object driven from outside (Driven), the pose is the base pose; the
velocity of a driven object is unknown here. The pose of a Simulated object depends on its body, not on time.
"""

from math import cos, pi, sin
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type, by_type_with_default
from softfinger.proxy.kernels.model import (
    SIMULATED,
    SINUSOID,
    STILL,
    TURNTABLE,
    Driven,
    Motion,
    Pose,
    Quaternion,
    Simulated,
    Sinusoid,
    Turntable,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.scalars import fraction
from softfinger.proxy.kernels.query.bodies import POSITION, pose_of_body


@by_type
def pose_at(motion: Any, pose: Pose, time: float) -> Any: ...


@jit
def rotation_about(axis: Vec3, angle: float) -> Quaternion:
    """Return the rotation by `angle` rad about the unit vector `axis`."""
    s = sin(0.5 * angle)
    return (cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@jit
def pose_in_world(pose: Pose, position: Vec3, turn: Quaternion) -> Pose:
    """Return the pose in the world of a position (3,) m and a rotation in the frame `pose`."""
    moved = vec3.add(pose.position, rotations.rotate(pose.orientation, position))
    return Pose(moved, rotations.multiply(pose.orientation, turn))


@by_type
def moving_pose(motion: Any, pose: Any) -> Any:
    """Return the pose of an object that can move, None for one that cannot."""


@moving_pose.of(None)
def pose_of_fixed(motion: None, pose: Any) -> None:
    return None


@moving_pose.otherwise
def pose_of_moving(motion: Any, pose: Pose) -> Pose:
    return pose


@pose_at.of(None, Driven)
def pose_at_rest(motion: Any, pose: Pose, time: float) -> Pose:
    """Return the base pose; commands from outside set that of a driven object."""
    return pose


@pose_at.of(Sinusoid)
def pose_of_sinusoid(motion: Sinusoid, pose: Pose, time: float) -> Pose:
    """Translate by s A and rotate by s alpha about the axis through the origin, with s = sin(2 pi f t + phase)."""
    # The sine of an unreduced angle would be inexact.
    s = sin(2.0 * pi * fraction(motion.frequency * time) + motion.phase)
    return pose_in_world(pose, vec3.scale(s, motion.translation), rotation_about(motion.axis, s * motion.angle))


@pose_at.of(Turntable)
def pose_of_turntable(motion: Turntable, pose: Pose, time: float) -> Pose:
    """Rotate by rate * t about the axis through the pivot, the point of the object that does not move."""
    turn = rotation_about(motion.axis, 2.0 * pi * fraction(motion.rate * time / (2.0 * pi)))
    return pose_in_world(pose, vec3.sub(motion.pivot, rotations.rotate(turn, motion.pivot)), turn)


@pose_at.of(Simulated)
def pose_of_simulated(motion: Simulated, pose: Pose, time: float) -> Pose:
    """Return the pose of an object attached to a body; its base pose is in the frame of the body."""
    return pose_in_world(pose_of_body(motion.block, motion.body, POSITION), pose.position, pose.orientation)


@pose_at.of(Motion)
def pose_of_any(motion: Motion, pose: Pose, time: float) -> Pose:
    if motion.kind == SINUSOID:
        oscillation = Sinusoid(motion.translation, motion.axis, motion.angle, motion.frequency, motion.phase)
        return pose_of_sinusoid(oscillation, pose, time)
    if motion.kind == TURNTABLE:
        return pose_of_turntable(Turntable(motion.axis, motion.rate, motion.pivot), pose, time)
    if motion.kind == SIMULATED:
        return pose_in_world(pose_of_body(motion.block, motion.body, POSITION), pose.position, pose.orientation)
    return pose


@moving_pose.of(Motion)
def moving_pose_of_any(motion: Motion, pose: Pose) -> Pose:
    """Return the identity for a fixed object: its base pose is applied elsewhere, as for a single object."""
    return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) if motion.kind == STILL else pose


@by_type_with_default
def can_move(motion: Any) -> float:
    """Return 1 for a motion that can change an object's pose, else 0."""
    return 1.0


@can_move.of(None)
def cannot_move(motion: None) -> float:
    return 0.0


@can_move.of(Motion)
def any_can_move(motion: Motion) -> float:
    return 0.0 if motion.kind == STILL else 1.0
