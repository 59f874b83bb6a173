"""`bench step`: cost of the contact step on a scene, and of the scene with one part after the other left out."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any, Final

import msgspec
import numpy as np

from softfinger.config.load import load_scene
from softfinger.config.schema import Scene
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.pack import flatten, pack, unpack
from softfinger.proxy.kernels.step import step
from softfinger.proxy.scene import build_scene, start_state
from softfinger.proxy.state import FREE
from softfinger.server.clock import now_ns
from softfinger.server.progress import progress
from softfinger.tools.measure import Array, add_output_options, figure, show

BLOCK: Final = 10_000
"""Steps between two looks at the clock; the clock's own cost is then below 0.01 ns a step."""
REFERENCE_OPERATIONS: Final = 100


@entry
def time_steps(
    scene: Any, values: Array, start: Any, state_values: Array, poses: Array, dt: float, timespec: Any, block_ns: Any
) -> tuple[float, int]:
    """Step through `poses` (n, 7) once for each block and note its time; returns a sum over all forces."""
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
def time_reference(factor: float, count: int, timespec: Any, block_ns: Any) -> float:
    """The same number of chains of REFERENCE_OPERATIONS multiplications and additions, each waiting for the last."""
    x = 0.5
    for block in range(block_ns.shape[0]):
        begun = now_ns(timespec)
        for _ in range(count):
            for _ in range(REFERENCE_OPERATIONS // 2):
                x = x * factor + 0.25
        block_ns[block] = now_ns(timespec) - begun
    return x


def touching_poses(radius_m: float, count: int) -> Array:
    """Poses (count, 7) of a fingertip that presses 1 mm into the plane z = 0, rolls, spins and drags; periodic."""
    t = 2.0 * np.pi * np.arange(count) / count
    poses = np.zeros((count, 7))
    poses[:, 0], poses[:, 1] = 0.004 * np.sin(3.0 * t), 0.002 * np.sin(2.0 * t)
    poses[:, 2] = 0.9 * radius_m
    roll, pitch, spin = 0.04 * np.sin(5.0 * t), 0.03 * np.sin(4.0 * t), 0.1 * np.sin(t)
    poses[:, 3:] = np.stack([np.ones(count), roll / 2, pitch / 2, spin / 2], axis=1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


def variants(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """The scene, then with fewer and fewer parts."""

    def material(**changes: Any) -> Scene:
        objects = tuple(
            msgspec.structs.replace(thing, material=msgspec.structs.replace(thing.material, **changes))
            for thing in scene.object
        )
        return msgspec.structs.replace(scene, object=objects)

    yield "everything in the scene", scene
    yield "without rolling", msgspec.structs.replace(scene, rolling=None)
    yield "without torsion", material(torsion=None)
    yield "without friction and rolling", msgspec.structs.replace(material(friction=None), rolling=None)
    yield "bare contact", msgspec.structs.replace(material(friction=None, torsion=None), rolling=None)


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    parser.add_argument("--blocks", type=int, default=200, help=f"blocks of {BLOCK} steps (default: %(default)s)")
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    scene = load_scene(args.scene)
    timespec, dt = np.zeros(2, np.int64), 0.001
    blocks = np.zeros(max(args.blocks, 1), np.int64)
    poses = touching_poses(scene.fingertip.radius_m, BLOCK)
    rows: list[dict[str, Any]] = []
    with progress("measuring the contact step"):
        time_reference(0.5, 1, timespec, blocks[:1])
        for name, variant in variants(scene):
            tree = build_scene(variant)
            start = start_state(tree)
            values, state = flatten(tree), flatten(start)
            time_steps(tree, values, start, state, poses, dt, timespec, blocks[:1].copy())
            reference = np.zeros_like(blocks)
            time_reference(0.5, BLOCK // 100, timespec, reference)
            _, touching = time_steps(tree, values, start, state, poses, dt, timespec, blocks)
            rows.append(
                {
                    "variant": name,
                    "ns_per_step": float(np.median(blocks)) / BLOCK,
                    "p99_block_ns_per_step": float(np.percentile(blocks, 99)) / BLOCK,
                    "reference_ns": float(np.median(reference)) / (BLOCK // 100),
                    "in_contact": touching / (BLOCK * len(blocks)),
                }
            )
    result = {"scene": args.scene, "steps": BLOCK * len(blocks), "variants": rows}
    text = f"a chain of {REFERENCE_OPERATIONS} dependent floating-point operations"
    lines = [f"contact step on {args.scene}, back to back; ratio to {text}"]
    for row in rows:
        cost, unit = row["ns_per_step"], row["reference_ns"]
        lines.append(f"  {row['variant']:<30} {cost:8.1f} ns   {cost / unit:6.3f} of {unit:.0f} ns")
    show(result, args.json, lines)
    if args.plot:
        drawing = figure(args.plot)
        axes = drawing.add_subplot()
        axes.barh([row["variant"] for row in rows][::-1], [row["ns_per_step"] for row in rows][::-1])
        axes.set_xlabel("ns per step, back to back")
        drawing.savefig(args.plot)
    return 0
