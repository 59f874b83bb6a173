"""Poses of all objects in a tick, computed once by `step` and read by every finger.

An object moves by a function of time, by commands from outside, or by the forces of a simulation. Other modules only
read the resulting poses from the World; the kind of motion makes no difference to them.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import SIMULATED, Many, Material, Single, World
from softfinger.proxy.kernels.query.bodies import LAST_POSITION, read_body_pose
from softfinger.proxy.kernels.query.container import POSE_MEMORY_SIZE, TIME_OFFSET, read_pose, write_pose
from softfinger.proxy.kernels.query.motion import compose_pose, compute_pose, select_moving_pose


@jit
def advance(objects: Any, world: World, dt: float) -> World:
    """Return the world after a tick of `dt` s, with the new pose of every object that can move.

    Of many objects, the poses of this tick and of the last are written to the memory of the world.
    """
    time, memory = world.time + dt, world.poses
    if isinstance(objects, Single):
        body = objects.body
        pose = select_moving_pose(body.motion, compute_pose(body.motion, body.pose, time))
        last_pose = memory if world.started != 0.0 else pose  # in the first tick, the object counts as not having moved
        return World(started=1.0, time=time, poses=pose, last_pose=last_pose, surfaces=world.surfaces)
    for i in range(int(objects.movable_count)):
        row = objects.movable_rows[i]
        entry, start = objects.entries[row], POSE_MEMORY_SIZE * row
        motion, rest_pose = entry.motion, entry.pose
        pose = compute_pose(motion, rest_pose, time)
        before = pose
        if motion.kind == SIMULATED:
            frame = read_body_pose(motion.block, motion.body, LAST_POSITION)
            before = compose_pose(frame, rest_pose.position, rest_pose.orientation)
        elif world.started != 0.0 and memory[start + TIME_OFFSET] == world.time:
            before = read_pose(memory, start)
        write_pose(memory, start + 7, before)
        write_pose(memory, start, pose)
        memory[start + TIME_OFFSET] = time
    return World(started=1.0, time=time, poses=world.poses, last_pose=None, surfaces=world.surfaces)


@jit
def place_all(objects: Any, world: World) -> Any:
    """Return all objects with their poses of this tick and the last: `poses` and `last_pose` of the World."""
    if isinstance(objects, Many):
        return replace(objects, "poses", world.poses)
    pose = objects.body.pose if world.poses is None else world.poses
    return replace(objects, "body", replace(objects.body, "pose", pose, "last_pose", world.last_pose))


@jit
def strip_materials(objects: Any) -> Any:
    """Return the objects without friction, torsion, effects and texture: geometry and normal force do not need them.

    Kernels for bare objects are compiled once for all scenes with objects of this type, and cached.
    """
    if isinstance(objects, Many):
        return replace(objects, "materials", None, "textures", None, "effects", ())
    material = Material(objects.body.material.normal, None, None)
    return Single(replace(objects.body, "material", material, "texture", None), (), objects.search)
