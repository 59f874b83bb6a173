"""The two containers of a scene's objects: one object of a known shape, or many as data.

    body = find_object(objects, index)

All queries of one object start with this call. The index is that of the triangle in a scene of a single mesh, and 0 for
another single object. Of many it is the row, plus MAX_ENTRIES times the index of the triangle of a mesh.
"""

from typing import Any, Final

from softfinger.proxy.kernels.jit.arrays import Mutable
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    CREASED,
    STILL,
    WORLD_PLANE,
    AnyShape,
    Facet,
    Many,
    Material,
    Mesh,
    MinkowskiSum,
    Object,
    Plane,
    Pose,
    Single,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.shapes.any_shape import plane_of

ENTRY_BITS: Final = 16
MAX_ENTRIES: Final = 1 << ENTRY_BITS
"""Largest number of objects. The triangle's index is in the upper bits of an index, which a float64 holds exactly."""
POSE_MEMORY_SIZE: Final = 16
"""Numbers in the World's memory for one object: its poses of this tick and the last, and the time of the write."""
TIME_OFFSET: Final = 14
NO_WORLD_PLANE: Final = Plane((0.0, 0.0, 1.0), 0.0)
"""Placeholder in the result of `find_world_plane`."""
SQUARE_MARGIN: Final = 1.0 + 1e-9
"""Factor on a squared distance that covers its rounding."""


@jit
def find_object(objects: Any, index: float) -> Any:
    """Return the object `index`, the first object for an index below 0.

    Of many, the compiler loads only the fields that the caller uses.
    """
    if isinstance(objects, Single):
        body = objects.body
        return replace(body, "shape", Facet(body.shape, index)) if isinstance(body.shape, Mesh) else body
    row, facet = extract_row(index), extract_facet(index)
    entry = objects.entries[row]
    pose, last_pose = find_poses(objects, row)
    return Object(
        shape=make_shape(objects.tip, replace(entry.shape, "facet", facet), pose),
        pose=pose,
        motion=entry.motion,
        material=read_material(objects.materials, entry.normal, row),
        scene_index=entry.scene_index,
        last_pose=last_pose,
        texture=None if objects.textures is None else objects.textures[row],
    )


@jit
def find_world_plane(objects: Any, index: float) -> tuple[bool, Plane]:
    """Return True and its Plane if object `index` of many is a plane at rest, otherwise False.

    Such a plane is in the world frame, and its queries need no pose. The compiler knows that of a single object. An
    ellipsoidal fingertip touches Minkowski sums, not planes.
    """
    if isinstance(objects, Many) and objects.tip is None:
        shape = objects.entries[extract_row(index)].shape
        if shape.surface == WORLD_PLANE:
            return True, plane_of(shape)
    return False, NO_WORLD_PLANE


@jit
def extract_row(index: float) -> int:
    """Return the row of one of many objects."""
    return max(int(index), 0) & (MAX_ENTRIES - 1)


@jit
def extract_facet(index: float) -> float:
    """Return the index of the triangle of one of many objects."""
    return float(max(int(index), 0) >> ENTRY_BITS)


@jit
def find_facet_step(objects: Any) -> float:
    """Return the difference between the indices of two neighbouring triangles of a mesh."""
    return 1.0 if isinstance(objects, Single) else float(MAX_ENTRIES)


@jit
def find_poses(objects: Many, row: int) -> tuple[Pose, Pose]:
    """Return the poses of one of many objects in this tick and in the last."""
    entry = objects.entries[row]
    if objects.poses is None or entry.motion.kind == STILL:
        return entry.pose, entry.pose
    start = POSE_MEMORY_SIZE * row
    return read_pose(objects.poses, start), read_pose(objects.poses, start + 7)


@jit
def read_pose(poses: Mutable, i: int) -> Pose:
    """Return the pose stored from index `i`."""
    return Pose((poses[i], poses[i + 1], poses[i + 2]), (poses[i + 3], poses[i + 4], poses[i + 5], poses[i + 6]))


@jit
def write_pose(poses: Mutable, start: int, pose: Pose) -> None:
    """Store a pose from index `start`."""
    for i in range(3):
        poses[start + i] = pose.position[i]
    for i in range(4):
        poses[start + 3 + i] = pose.orientation[i]


@jit
def make_shape(tip: Any, shape: AnyShape, pose: Pose) -> Any:
    """Return the shape, for an ellipsoidal fingertip its Minkowski sum with the fingertip."""
    if tip is None:
        return shape
    axes = rotations.multiply(rotations.conjugate(pose.orientation), tip.orientation)
    return MinkowskiSum(shape, tip.semi_axes, axes, tip.radius)


@jit
def read_material(materials: Any, normal: Any, row: int) -> Any:
    """Return the material of one of many objects; bare objects have only a normal law."""
    return Material(normal, None, None) if materials is None else replace(materials[row], "normal", normal)


@jit
def find_largest_semi_axis(tip: Any) -> float:
    """Return the largest semi-axis of an ellipsoidal fingertip, m, otherwise 0."""
    if tip is None:
        return 0.0
    return max(tip.semi_axes[0], tip.semi_axes[1], tip.semi_axes[2])


@jit
def is_beyond(objects: Many, row: int, x: Vec3, limit: float) -> bool:
    """Return True if the bounding volume of an object is farther than `limit` (m) from `x`; takes 2 ns.

    The volume is a ball, for a height map all below its largest height, `reach`.
    """
    shape, (pose, _) = objects.entries[row].shape, find_poses(objects, row)
    if shape.surface == CREASED:
        return into(pose, x)[2] - shape.reach > max(limit, 0.0) * SQUARE_MARGIN
    offset = vec3.sub(x, pose.position)
    distance = max(limit, 0.0) + shape.reach + find_largest_semi_axis(objects.tip)
    return vec3.dot(offset, offset) > SQUARE_MARGIN * distance * distance
