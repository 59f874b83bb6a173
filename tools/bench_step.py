"""`bench step`: cost of the contact step on scenes, and of each scene without one part after the other."""

from __future__ import annotations

import argparse
from typing import Any, Final

import numpy as np

from softfinger.config.load import load_scene, shipped
from softfinger.config.schema import Scene
from softfinger.proxy.kernels.jit import entry
from softfinger.server.clock import now_ns
from softfinger.server.cost import BLOCK, Array, bare, measure, touching_poses, without_parts
from softfinger.server.progress import progress
from softfinger.tools.measure import add_output_options, figure, show

REFERENCE_OPERATIONS: Final = 100
CORNER: Final = "corner"
"""Shipped scene of three walls: its poses press into all of them at once."""


@entry
def time_reference(factor: float, count: int, timespec: Any, block_ns: Any) -> float:
    """Chains of REFERENCE_OPERATIONS multiplications and additions, each waiting for the one before."""
    x = 0.5
    for block in range(block_ns.shape[0]):
        begun = now_ns(timespec)
        for _ in range(count):
            for _ in range(REFERENCE_OPERATIONS // 2):
                x = x * factor + 0.25
        block_ns[block] = now_ns(timespec) - begun
    return x


def reference_ns() -> float:
    """Time of one such chain now, ns."""
    blocks, count = np.zeros(50, np.int64), 100
    time_reference(0.5, count, np.zeros(2, np.int64), blocks)
    return float(np.median(blocks)) / count


def corner_poses(count: int = BLOCK) -> Array:
    """Poses (count, 7) pressed 1 mm and a little into three walls at right angles, turning; radius 10 mm."""
    poses = np.zeros((count, 7))
    t = 2.0 * np.pi * np.arange(count) / count
    poses[:, :3] = 0.009 + 0.0005 * np.stack([np.sin(3.0 * t), np.sin(2.0 * t), np.sin(5.0 * t)], axis=1)
    poses[:, 3], poses[:, 4], poses[:, 6] = 1.0, 0.02 * np.sin(5.0 * t), 0.05 * np.sin(t)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", nargs="*", default=["paper-plane"], help="scene files or names (%(default)s)")
    parser.add_argument("--all", action="store_true", help="every shipped scene")
    parser.add_argument("--blocks", type=int, default=100, help=f"blocks of {BLOCK} steps (default: %(default)s)")
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    names = shipped(Scene) if args.all else args.scene
    blocks = max(args.blocks, 1)
    scenes = []
    with progress("measuring the contact step", len(names)) as done:
        for number, name in enumerate(names):
            scenes.append({"scene": name, "variants": variants(name, load_scene(name), blocks)})
            done(number + 1)
    result = {"steps": BLOCK * blocks, "scenes": scenes, **scenes[0]}
    lines = [f"contact step, back to back; ratio to a chain of {REFERENCE_OPERATIONS} dependent operations"]
    for found in scenes:
        lines.append(str(found["scene"]))
        for row in found["variants"]:
            cost, unit = row["ns_per_step"], row["reference_ns"]
            marginal = f"{row['marginal_ns']:+8.1f} ns" if "marginal_ns" in row else ""
            lines.append(f"  {row['variant']:<46}{cost:8.1f} ns {cost / unit:7.3f} of {unit:.0f} ns {marginal}")
    show(result, args.json, lines)
    if args.plot:
        drawing = figure(args.plot, height=1.0 + 0.3 * sum(len(found["variants"]) for found in scenes))
        axes = drawing.add_subplot()
        rows = [
            (f"{found['scene']}: {row['variant']}", row["ns_per_step"]) for found in scenes for row in found["variants"]
        ]
        axes.barh([label for label, _ in rows][::-1], [cost for _, cost in rows][::-1])
        axes.set_xlabel("ns per step, back to back")
        drawing.savefig(args.plot)
    return 0


def variants(name: str, scene: Scene, blocks: int) -> list[dict[str, Any]]:
    """Cost of a scene whole, without each part, and bare."""
    poses = corner_poses() if name == CORNER else touching_poses(scene)
    rows: list[dict[str, Any]] = []
    for label, part in [
        ("whole", scene),
        *((f"without {n}", s) for n, s in without_parts(scene)),
        ("bare", bare(scene)),
    ]:
        unit, cost = reference_ns(), measure(part, poses, blocks)
        row = {"variant": label, "ns_per_step": cost.median_ns, "p99_block_ns_per_step": cost.p99_ns}
        row |= {"reference_ns": unit, "in_contact": cost.in_contact}
        if label.startswith("without"):
            row["marginal_ns"] = rows[0]["ns_per_step"] - cost.median_ns
        rows.append(row)
    return rows
