"""What a tick of a scene costs, and what each of its parts adds: measured here and now, back to back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.bodies import closest_to
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.pack import flatten, pack, unpack
from softfinger.proxy.kernels.step import step
from softfinger.proxy.scene import build_scene, start_state
from softfinger.proxy.state import FREE
from softfinger.server.clock import now_ns

Array = NDArray[np.float64]

BLOCK: Final = 10_000
"""Steps between two looks at the clock; the clock's own cost is then below 0.01 ns a step."""
PRESS_N: Final = 1.0


class Cost(NamedTuple):
    """Time of one step, ns: median and 99th percentile over blocks; the share of steps in contact."""

    median_ns: float
    p99_ns: float
    in_contact: float


@entry
def time_steps(
    scene: Any, values: Array, start: Any, state_values: Array, poses: Array, dt: float, timespec: Any, block_ns: Any
) -> tuple[float, int]:
    """Step through `poses` (n, 7) once for each block and note its time; returns a sum of forces, and the contacts."""
    parameters, total, touching = unpack(scene, values), 0.0, 0
    state = unpack(start, state_values)
    for block in range(block_ns.shape[0]):
        begun = now_ns(timespec)
        for i in range(poses.shape[0]):
            pose = poses[i]
            position, orientation = (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6])
            state, contact = step(parameters, state, position, orientation, dt)
            total += contact.force[0] + contact.force[2] + contact.torque[2]
            touching += contact.mode != FREE
        block_ns[block] = now_ns(timespec) - begun
    pack(state_values, state)
    return total, touching


@entry
def follow_surface(scene: Any, values: Array, points: Array, depth: float) -> None:
    """Move each of `points` (n, 3) to where a fingertip presses `depth` into the first object, nearest to it."""
    parameters = unpack(scene, values)
    for i in range(points.shape[0]):
        x = (points[i, 0], points[i, 1], points[i, 2])
        _, foot, normal = closest_to(parameters.objects, 0.0, x)
        at = vec3.add_scaled(foot, parameters.radius - depth, normal)
        points[i, 0], points[i, 1], points[i, 2] = at


def touching_poses(scene: schema.Scene, count: int = BLOCK) -> Array:
    """Poses (count, 7) of a fingertip that presses 1 N into the first object, rolls, spins and drags; periodic."""
    tree = build_scene(scene)
    thing, radius = scene.object[0], scene.fingertip.radius_m
    values = flatten(tree)
    # Some point outside of the object: the first of a few around it that the fingertip fits at.
    around = np.random.default_rng(0).normal(size=(64, 3))
    around *= (np.geomspace(1e-3, 1e4, 64) * radius / np.linalg.norm(around, axis=1))[:, None]
    seat = around + thing.position_m
    follow_surface(tree, values, seat, 0.0)
    gaps = np.linalg.norm(seat - seat[0], axis=1)
    base = seat[int(np.argmin(gaps))]
    t = 2.0 * np.pi * np.arange(count) / count
    poses = np.zeros((count, 7))
    sway = np.stack([0.4 * np.sin(3.0 * t), 0.2 * np.sin(2.0 * t), 0.3 * np.sin(4.0 * t)], axis=1)
    poses[:, :3] = base + radius * sway
    points = np.ascontiguousarray(poses[:, :3])
    follow_surface(tree, values, points, PRESS_N / thing.material.stiffness_n_per_m)
    poses[:, :3] = points
    turns = np.stack([0.04 * np.sin(5.0 * t), 0.03 * np.sin(4.0 * t), 0.1 * np.sin(t)], axis=1)
    poses[:, 3:] = np.concatenate([np.ones((count, 1)), turns / 2.0], axis=1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


def measure(scene: schema.Scene, poses: Array, blocks: int = 50) -> Cost:
    """Cost of a step of `scene` over `poses`; compiles what is not compiled yet."""
    tree = build_scene(scene)
    start = start_state(tree)
    values, state, timespec = flatten(tree), flatten(start), np.zeros(2, np.int64)
    times = np.zeros(blocks, np.int64)
    time_steps(tree, values, start, state, poses, 0.001, timespec, times[:1].copy())
    _, touching = time_steps(tree, values, start, state, poses, 0.001, timespec, times)
    each = times / len(poses)
    return Cost(float(np.median(each)), float(np.percentile(each, 99)), touching / (len(poses) * blocks))


def without_parts(scene: schema.Scene) -> Iterator[tuple[str, schema.Scene]]:
    """The scene with one part after the other left out, and the name of that part."""
    replace = msgspec.structs.replace

    def material(**changes: Any) -> tuple[Any, ...]:
        return tuple(replace(thing, material=replace(thing.material, **changes)) for thing in scene.object)

    if scene.rolling is not None:
        yield f"rolling ({scene.rolling.method})", replace(scene, rolling=None)
    if any(thing.material.torsion for thing in scene.object):
        yield "torsion", replace(scene, object=material(torsion=None))
    if any(thing.material.friction for thing in scene.object):
        yield "friction and rolling", replace(scene, rolling=None, object=_frictionless(scene))
    if scene.effect:
        yield "effects of the workspace", replace(scene, effect=())
    if any(thing.effect for thing in scene.object):
        yield "effects of objects", replace(scene, object=tuple(replace(thing, effect=()) for thing in scene.object))
    if any(thing.motion for thing in scene.object):
        yield "motion", replace(scene, object=tuple(replace(thing, motion=None) for thing in scene.object))
    if len(scene.object) > 1:
        yield f"all objects but '{scene.object[0].name}'", replace(scene, object=scene.object[:1])


def bare(scene: schema.Scene) -> schema.Scene:
    """The first object alone, without friction, torsion, rolling, effects and motion."""
    replace = msgspec.structs.replace
    thing = scene.object[0]
    plain = replace(thing.material, friction=None, torsion=None)
    return replace(scene, rolling=None, effect=(), object=(replace(thing, material=plain, effect=(), motion=None),))


def _frictionless(scene: schema.Scene) -> tuple[Any, ...]:
    replace = msgspec.structs.replace
    objects = []
    for thing in scene.object:
        torsion = thing.material.torsion
        if torsion is not None and torsion.model == "limit_surface":  # shares its limit with friction
            torsion = replace(torsion, model="independent")
        objects.append(replace(thing, material=replace(thing.material, friction=None, torsion=torsion)))
    return tuple(objects)
