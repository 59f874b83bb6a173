"""Poses of all objects in a tick, computed once by `step` and read by every finger.

An object moves by a function of time, by commands from outside, or by the forces of a simulation. Other modules only
read the resulting poses from the World; the kind of motion makes no difference to them.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_count, by_type
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Material, Object, Pose, World
from softfinger.proxy.kernels.query.elements import element
from softfinger.proxy.kernels.query.motion import moving_pose, pose_at


@jit
def advance(objects: Any, world: World, dt: float) -> World:
    """Return the world after a tick of `dt` s, with the new pose of every object that can move."""
    time = world.time + dt
    poses = poses_at(objects, time)
    return World(started=1.0, time=time, poses=poses, was=before(poses, world.poses, world.started))


@by_count
def poses_at(objects: Any, time: float) -> Any:
    """Return the poses of all objects at `time` (s), None for one that cannot move."""


@poses_at.of(1)
def pose_of_one_at(objects: Any, time: float) -> Any:
    return (entry_at(objects[0], time),)


@poses_at.of(2)
def poses_of_several_at(objects: Any, time: float) -> Any:
    # numba can concatenate tuples of known types, but cannot unpack one inside another.
    return (entry_at(objects[0], time),) + poses_at(objects[1:], time)  # noqa: RUF005


@by_type
def entry_at(entry: Any, time: float) -> Any:
    """Return the pose of an entry at `time` (s); None if it cannot move, and for rows, which read it from bodies."""


@entry_at.of(Rows)
def rows_at(entry: Any, time: float) -> None:
    return None


@entry_at.otherwise
def object_at(entry: Any, time: float) -> Any:
    body = element(entry, 0.0)
    return moving_pose(body.motion, pose_at(body.motion, body.pose, time))


@by_type
def since(was: Any, started: float, pose: Any) -> Any:
    """Return the pose of an object at the last tick, None if it cannot move.

    In the first tick this is the current pose: the object counts as not having moved.
    """


@since.of(None)
def since_ever(was: None, started: float, pose: Any) -> None:
    return None


@since.of(Pose)
def since_last_tick(was: Pose, started: float, pose: Pose) -> Pose:
    return was if started != 0.0 else pose


@by_count
def before(poses: Any, was: Any, started: float) -> Any:
    """Return the poses of all objects at the last tick, see `since`."""


@before.of(1)
def one_before(poses: Any, was: Any, started: float) -> Any:
    return (since(was[0], started, poses[0]),)


@before.of(2)
def several_before(poses: Any, was: Any, started: float) -> Any:
    return (since(was[0], started, poses[0]),) + before(poses[1:], was[1:], started)  # noqa: RUF005  # see above


@by_type
def standing(pose: Any, rest: Any) -> Any:
    """Return the pose in the world: `pose`, or the base pose `rest` if the object cannot move (None)."""


@standing.of(None)
def standing_at_rest(pose: None, rest: Any) -> Any:
    return rest


@standing.of(Pose)
def standing_where_it_moved(pose: Pose, rest: Any) -> Pose:
    return pose


@by_type
def place(body: Any, pose: Any, was: Any) -> Any:
    """Return the object with its poses of this tick and the last, from the World."""


@place.of(Rows)
def place_of_rows(body: Any, pose: Any, was: Any) -> Any:
    return body  # the pose is computed when an element is read: `in_row`


@place.of(Object)
def place_of_object(body: Object, pose: Any, was: Any) -> Any:
    return replace(body, "pose", standing(pose, body.pose), "was", was)


@by_count
def place_all(objects: Any, poses: Any, was: Any) -> Any:
    """Return all objects with their poses of this tick and the last: `poses` and `was` of the World."""


@place_all.of(1)
def place_one(objects: Any, poses: Any, was: Any) -> Any:
    return (place(objects[0], poses[0], was[0]),)


@place_all.of(2)
def place_several(objects: Any, poses: Any, was: Any) -> Any:
    return (place(objects[0], poses[0], was[0]),) + place_all(objects[1:], poses[1:], was[1:])  # noqa: RUF005  # see above


@by_type
def bare(body: Any) -> Any:
    """Return the object without friction, torsion, effects and texture: geometry and normal force do not need them.

    Kernels for bare objects are compiled once for all scenes whose objects have these shapes, and cached.
    """


@bare.of(Rows)
def bare_rows(body: Any) -> Any:
    return body  # in memory, cannot be changed


@bare.of(Object)
def bare_object(body: Object) -> Any:
    material = Material(body.material.normal, None, None)
    return replace(body, "material", material, "effects", (), "texture", None)


@by_count
def all_bare(objects: Any) -> Any:
    """Return all objects bare, see `bare`."""


@all_bare.of(1)
def one_bare(objects: Any) -> Any:
    return (bare(objects[0]),)


@all_bare.of(2)
def several_bare(objects: Any) -> Any:
    return (bare(objects[0]),) + all_bare(objects[1:])  # noqa: RUF005  # see above
