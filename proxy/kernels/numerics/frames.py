"""Transformations between the world frame and the frame of a pose.

A pose is None (the world frame itself), a Place (translation) or a Pose (translation and rotation).
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Place, Pose, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3


@jit
def into(pose: Any, x: Vec3) -> Vec3:
    """Transform a point from the world frame to the object's frame."""
    if pose is None:
        return x
    if isinstance(pose, Place):
        return vec3.sub(x, pose.position)
    return rotations.rotate(rotations.conjugate(pose.orientation), vec3.sub(x, pose.position))


@jit
def out_of(pose: Any, x: Vec3) -> Vec3:
    """Transform a point from the object's frame to the world frame."""
    if pose is None:
        return x
    if isinstance(pose, Place):
        return vec3.add(x, pose.position)
    return vec3.add(rotations.rotate(pose.orientation, x), pose.position)


@jit
def turn_into(pose: Any, v: Vec3) -> Vec3:
    """Rotate a direction from the world frame to the object's frame."""
    if pose is None or isinstance(pose, Place):
        return v
    return rotations.rotate(rotations.conjugate(pose.orientation), v)


@jit
def turn_out_of(pose: Any, v: Vec3) -> Vec3:
    """Rotate a direction from the object's frame to the world frame."""
    if pose is None or isinstance(pose, Place):
        return v
    return rotations.rotate(pose.orientation, v)


@jit
def pose_values(pose: Any) -> Pose:
    """Convert any pose to a Pose."""
    if pose is None:
        return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    if isinstance(pose, Place):
        return Pose(pose.position, (1.0, 0.0, 0.0, 0.0))
    return Pose(pose.position, pose.orientation)
