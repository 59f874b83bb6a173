"""Transformations between the world frame and the frame of a pose.

A pose is None (the world frame itself), a Place (translation) or a Pose (translation and rotation).
"""

from typing import Any

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Place, Pose, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3


@by_type
def into(pose: Any, x: Vec3) -> Any:
    """Transform a point from the world frame to the object's frame."""


@by_type
def out_of(pose: Any, x: Vec3) -> Any:
    """Transform a point from the object's frame to the world frame."""


@by_type
def turn_into(pose: Any, v: Vec3) -> Any:
    """Rotate a direction from the world frame to the object's frame."""


@by_type
def turn_out_of(pose: Any, v: Vec3) -> Any:
    """Rotate a direction from the object's frame to the world frame."""


@into.of(None)
def into_world(pose: None, x: Vec3) -> Vec3:
    return x


@out_of.of(None)
def out_of_world(pose: None, x: Vec3) -> Vec3:
    return x


@turn_into.of(None, Place)
def turn_into_place(pose: Any, v: Vec3) -> Vec3:
    return v


@turn_out_of.of(None, Place)
def turn_out_of_place(pose: Any, v: Vec3) -> Vec3:
    return v


@into.of(Place)
def into_place(pose: Place, x: Vec3) -> Vec3:
    return vec3.sub(x, pose.position)


@out_of.of(Place)
def out_of_place(pose: Place, x: Vec3) -> Vec3:
    return vec3.add(x, pose.position)


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


@by_type
def pose_values(pose: Any) -> Any:
    """Convert any pose to a Pose."""


@pose_values.of(None)
def pose_of_world(pose: None) -> Pose:
    return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@pose_values.of(Place)
def pose_of_place(pose: Place) -> Pose:
    return Pose(pose.position, (1.0, 0.0, 0.0, 0.0))


@pose_values.of(Pose)
def pose_of_pose(pose: Pose) -> Pose:
    return pose
