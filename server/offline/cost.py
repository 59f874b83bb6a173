"""Cost of a tick of a scene and of each of its parts, measured back to back on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.proxy.kernels.contact.fingertip import minkowski_objects
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import PackedTree, flatten, pack, packed, unpack
from softfinger.proxy.kernels.jit.tuples import first_of
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.objects import find_closest_within
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.kernels.step import step
from softfinger.proxy.record import FREE
from softfinger.proxy.scene import build_scene, start_state
from softfinger.server.loop.clock import Stopwatch, make_stopwatch, read_clock_ns, read_thread_cpu_ns, sleep_until
from softfinger.server.loop.tuning import estimate_kernels as estimate_loop_kernels

BLOCK: Final = 10_000
"""Steps per block: one pass over the poses."""
STRETCH_STEPS: Final = 200
"""Steps per stretch between two clock readings, about 20 us.

Few stretches are affected if another program takes the processor for a millisecond. Reading the clock costs about 0.1
ns per step.
"""
PRESS_N: Final = 1.0
STEP_SHARE: Final = 0.67
PART_KERNELS: Final = 25
"""Kernels of the step as a share of those of the loop, and of a scene without a part; `paper-plane` has 258 in all."""


class Cost(NamedTuple):
    """Time of one step, ns, and fraction of steps in contact.

    median_ns  mean over the stretches of STRETCH_STEPS poses of their median over the blocks
    p99_ns     99th percentile over all stretches
    cpu_ns     median over blocks of the thread's processor time
    """

    median_ns: float
    p99_ns: float
    in_contact: float
    cpu_ns: float


@entry
def time_steps(
    scene: PackedTree,
    start: PackedTree,
    poses: Array,
    dt: float,
    watch: Stopwatch,
    cpu_ns: NDArray[np.int64],
    pause_ns: int = 0,
) -> tuple[float, int]:
    """Step through `poses` (n, 7), the same for every finger, once per block.

    start    State at the first step; updated to the last
    watch    (blocks, m)  time of each of m stretches of n // m poses, written
    cpu_ns   (blocks,)    processor time of the thread, written
    pause_ns              sleep between stretches, as the servo loop does between ticks

    Returns a sum of forces, and the number of steps with contact of the first finger.
    """
    parameters, total, touching = unpack(scene.like, scene.values), 0.0, 0
    state, timespec, short_ns = unpack(start.like, start.values), watch.timespec, watch.ns
    length = poses.shape[0] // short_ns.shape[1]
    for block in range(short_ns.shape[0]):
        cpu_start_ns = read_thread_cpu_ns(timespec)
        for stretch in range(short_ns.shape[1]):
            if pause_ns > 0:
                sleep_until(read_clock_ns(timespec) + pause_ns, timespec)
            start_ns = read_clock_ns(timespec)
            for i in range(stretch * length, (stretch + 1) * length):
                pose = poses[i]
                position, orientation = (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6])
                probe = Pose(position, orientation)
                probes = first_of(parameters.fingers, probe, probe)
                state, contacts = step(parameters, state, probes, dt)
                contact = contacts[0]
                total += contact.force[0] + contact.force[2] + contact.torque[2]
                touching += contact.mode != FREE
            short_ns[block, stretch] = read_clock_ns(timespec) - start_ns
        cpu_ns[block] = read_thread_cpu_ns(timespec) - cpu_start_ns
    pack(start.values, state)
    return total, touching


@entry
def follow_surface(scene: Any, values: Array, points: Array, height: float) -> None:
    """Move each of `points` (n, 3) to `height` (m) above its nearest point on the surface of the first object.

    Surfaces are relative to the centre of the first finger (`minkowski_objects`): Minkowski sums for an
    ellipsoidal fingertip.
    """
    parameters = unpack(scene, values)
    finger = parameters.fingers[0]
    objects = minkowski_objects(finger, parameters.objects, (1.0, 0.0, 0.0, 0.0))
    for i in range(points.shape[0]):
        x = (points[i, 0], points[i, 1], points[i, 2])
        _, nearest, normal, _ = find_closest_within(objects, 0.0, x, BUDGET)
        at = vec3.add_scaled(nearest, height, normal)
        points[i, 0], points[i, 1], points[i, 2] = at


def make_touching_poses(scene: schema.Scene, count: int = BLOCK) -> Array:
    """Return periodic poses (count, 7) of a fingertip that presses 1 N into the first object, rolls, spins and drags.

    With several fingertips it is the one with the smallest radius.
    """
    tree = build_scene(scene)
    obj, radius = scene.object[0], min(finger.radius_m for finger in scene.fingers)
    values = flatten(tree)
    # A point outside the object: the first of random points around it at which the fingertip fits.
    offsets = np.random.default_rng(0).normal(size=(64, 3))
    offsets *= (np.geomspace(1e-3, 1e4, 64) * radius / np.linalg.norm(offsets, axis=1))[:, None]
    contacts = offsets + obj.position_m
    follow_surface(tree, values, contacts, radius)
    gaps = np.linalg.norm(contacts - contacts[0], axis=1)
    base = contacts[int(np.argmin(gaps))]
    t = 2.0 * np.pi * np.arange(count) / count
    poses = np.zeros((count, 7))
    sway = np.stack([0.4 * np.sin(3.0 * t), 0.2 * np.sin(2.0 * t), 0.3 * np.sin(4.0 * t)], axis=1)
    poses[:, :3] = base + radius * sway
    points = np.ascontiguousarray(poses[:, :3])
    follow_surface(tree, values, points, radius - obj.material.depth_under(PRESS_N))
    poses[:, :3] = points
    rotations = np.stack([0.04 * np.sin(5.0 * t), 0.03 * np.sin(4.0 * t), 0.1 * np.sin(t)], axis=1)
    poses[:, 3:] = np.concatenate([np.ones((count, 1)), rotations / 2.0], axis=1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


def measure(
    scene: schema.Scene, poses: Array, blocks: int = 50, advance: Callable[[int], None] = lambda number: None
) -> Cost:
    """Measure the cost of a step of `scene` over `poses`; compiles the kernels if necessary.

    `advance` is called with the number of measured blocks.
    """
    tree = build_scene(scene)
    parameters, state = packed(tree), packed(start_state(tree))
    stretches = max(1, len(poses) // STRETCH_STEPS)
    steps = len(poses) // stretches * stretches
    watch, cpu = make_stopwatch(blocks, stretches), np.zeros(blocks, np.int64)
    time_steps(parameters, state, poses, 0.001, make_stopwatch(1, stretches), cpu[:1].copy())
    touching = 0
    for block in range(blocks):
        row = slice(block, block + 1)
        touching += time_steps(parameters, state, poses, 0.001, watch._replace(ns=watch.ns[row]), cpu[row])[1]
        advance(block + 1)
    step_ns = watch.ns * (stretches / steps)
    return Cost(
        median_ns=float(np.mean(np.median(step_ns, axis=0))),
        p99_ns=float(np.percentile(step_ns, 99)),
        in_contact=touching / (steps * blocks),
        cpu_ns=float(np.median(cpu)) / steps,
    )


def iter_without_parts(scene: schema.Scene) -> Iterator[tuple[str, schema.Scene]]:
    """Yield the name of each part of the scene, and the scene without it."""
    replace = msgspec.structs.replace

    def material(**changes: Any) -> tuple[Any, ...]:
        return tuple(replace(obj, material=replace(obj.material, **changes)) for obj in scene.object)

    has_friction = any(obj.material.friction for obj in scene.object)
    parts = {
        f"rolling ({scene.rolling.method if scene.rolling else ''})": replace(scene, rolling=None),
        "law of the normal force": replace(scene, object=material(normal=None)),
        "ellipsoid": _with_tips(scene, _make_spherical) if any(finger.radii_m for finger in scene.fingers) else scene,
        "patch": _with_tips(scene, _make_rigid),
        "torsion": replace(scene, object=material(torsion=None)),
        "friction and rolling": replace(scene, rolling=None, object=_remove_friction(scene)) if has_friction else scene,
        "effects of the workspace": replace(scene, effect=()),
        "effects of objects": replace(scene, object=tuple(replace(obj, effect=()) for obj in scene.object)),
        "motion": replace(scene, object=tuple(replace(obj, motion=None) for obj in scene.object)),
        "texture": replace(scene, object=tuple(_remove_texture(obj) for obj in scene.object)),
        f"all objects but '{scene.object[0].name}'": replace(scene, object=scene.object[:1]),
    }
    yield from ((name, reduced) for name, reduced in parts.items() if reduced != scene)


def estimate_kernels(scene: schema.Scene, parts: int) -> int:
    """Return about how many kernels the measurements of a scene and of it without each part compile, for a message."""
    return int(STEP_SHARE * estimate_loop_kernels(scene)) + PART_KERNELS * (parts + 1)


def keep_contact(scene: schema.Scene) -> schema.Scene:
    """Return the scene with only its first object, with a linear normal force and no other part."""
    replace = msgspec.structs.replace
    obj = _remove_texture(scene.object[0])
    plain = replace(obj.material, normal=None, friction=None, torsion=None)
    first_object = replace(obj, material=plain, effect=(), motion=None)
    plain_tips = _with_tips(_with_tips(scene, _make_rigid), _make_spherical)
    return replace(plain_tips, rolling=None, effect=(), object=(first_object,))


def _with_tips(scene: schema.Scene, change: Callable[[Any], Any]) -> schema.Scene:
    tip = None if scene.fingertip is None else change(scene.fingertip)
    return msgspec.structs.replace(scene, fingertip=tip, finger=tuple(change(finger) for finger in scene.finger))


def _make_rigid(tip: Any) -> Any:
    return msgspec.structs.replace(tip, patch=None)


def _make_spherical(tip: Any) -> Any:
    return msgspec.structs.replace(tip, radius_m=tip.radius_range_m[0], radii_m=None, orientation_wxyz=None)


def _remove_texture(obj: schema.Object) -> schema.Object:
    return msgspec.structs.replace(obj, texture=None) if isinstance(obj, schema.Textured) else obj


def _remove_friction(scene: schema.Scene) -> tuple[Any, ...]:
    replace = msgspec.structs.replace
    objects = []
    for obj in scene.object:
        torsion = obj.material.torsion
        if torsion is not None and torsion.model == "limit_surface":  # shares its limit with friction
            torsion = replace(torsion, model="independent")
        if isinstance(obj, schema.Textured) and obj.texture is not None:
            heights = obj.texture.height_m
            obj = replace(obj, texture=heights and replace(obj.texture, friction_scale=None))
        objects.append(replace(obj, material=replace(obj.material, friction=None, torsion=torsion)))
    return tuple(objects)
