"""`bench step`: cost of the contact step on scenes, of each scene without its parts, and of every feature."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.schema import Scene
from softfinger.config.sources import list_shipped
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.server.loop.clock import Stopwatch, make_stopwatch, read_clock_ns
from softfinger.server.offline.cost import BLOCK, Cost, iter_without_parts, keep_contact, make_touching_poses, measure
from softfinger.server.offline.figures import make_figure, save
from softfinger.server.progress import map_with_progress
from softfinger.tools.bench.features import Feature, iter_features, make_corner_poses
from softfinger.tools.measure import show_and_draw

REFERENCE_OPERATIONS: Final = 100
CORNER: Final = "corner"
"""Shipped scene of three walls; its poses press into all of them at once."""
ROUNDS: Final = 40
"""Turns of the scenes that are compared, so that a slow moment of the machine affects all of them."""


@entry
def time_reference(factor: float, count: int, watch: Stopwatch) -> float:
    """Run chains of REFERENCE_OPERATIONS multiplications and additions, each dependent on the previous one."""
    x = 0.5
    for block in range(watch.ns.shape[0]):
        begun = read_clock_ns(watch.timespec)
        for _ in range(count):
            for _ in range(REFERENCE_OPERATIONS // 2):
                x = x * factor + 0.25
        watch.ns[block] = read_clock_ns(watch.timespec) - begun
    return x


def measure_reference_ns() -> float:
    """Measure the current duration (ns) of the reference computation, `time_reference`."""
    watch, count = make_stopwatch(50), 100
    time_reference(0.5, count, watch)
    return float(np.median(watch.ns)) / count


def run(args: argparse.Namespace) -> int:
    chosen = [] if args.features is None else select(list(iter_features()), args.features)
    names = list_shipped(Scene) if args.all else args.scene
    scenes = map_with_progress(
        "measuring the contact step",
        lambda name: {"scene": name, "variants": list_variants(name, load_scene(name), args.blocks)},
        names,
    )
    result = {"steps": BLOCK * args.blocks, "scenes": scenes} | (scenes[0] if scenes else {})
    if chosen:
        cost = partial(measure_cost, blocks=args.blocks)
        result["features"] = map_with_progress("measuring features", cost, chosen)
    return show_and_draw(args, result, format_table(result), lambda path: draw(result, path))


def select(offered: Sequence[Feature], patterns: Sequence[str]) -> list[Feature]:
    """Return the features with names that match a pattern, all without patterns.

    Raises ConfigError for a pattern without a match.
    """
    for pattern in patterns:
        if not any(fnmatch(feature.name, pattern) for feature in offered):
            raise ConfigError(
                f"--features {pattern!r}: no feature has such a name; there are "
                + "; ".join(feature.name for feature in offered)
            )
    return [f for f in offered if not patterns or any(fnmatch(f.name, pattern) for pattern in patterns)]


def list_variants(name: str, scene: Scene, blocks: int) -> list[dict[str, Any]]:
    poses = make_corner_poses() if name == CORNER else make_touching_poses(scene)
    parts = [
        ("whole", scene),
        *((f"without {n}", s) for n, s in iter_without_parts(scene)),
        ("bare", keep_contact(scene)),
    ]
    units, costs = measure_in_turns([(part, poses) for _, part in parts], blocks)
    rows: list[dict[str, Any]] = []
    for (label, _), turns in zip(parts, costs, strict=True):
        row = {"variant": label, "ns_per_step": find_quietest([cost.median_ns for cost in turns])}
        row["p99_block_ns_per_step"] = float(np.median([cost.p99_ns for cost in turns]))
        row["cpu_ns_per_step"] = find_quietest([cost.cpu_ns for cost in turns])
        row |= {"reference_ns": find_quietest(units), "in_contact": turns[0].in_contact}
        if label.startswith("without"):
            row["marginal_ns"] = rows[0]["ns_per_step"] - row["ns_per_step"]
        rows.append(row)
    return rows


def measure_in_turns(measured: Sequence[tuple[Scene, Any]], blocks: int) -> tuple[list[float], list[list[Cost]]]:
    """Measure scenes with their poses, `blocks` blocks each in ROUNDS turns.

    Returns the time of the reference in each turn, ns, and the Cost of each scene in each turn.
    """
    units, costs = [], []
    for _ in range(ROUNDS):
        units.append(measure_reference_ns())
        costs.append([measure(scene, poses, max(blocks // ROUNDS, 1)) for scene, poses in measured])
    return units, [list(turns) for turns in zip(*costs, strict=True)]


def find_quietest(values: Any) -> float:
    """Return the value of the quietest turn.

    Programs that share a core with this one slow its steps by a third, for seconds. A median over turns would be the
    value of slow turns in one run and of fast turns in another.
    """
    return float(np.min(values))


def measure_cost(feature: Feature, blocks: int) -> dict[str, Any]:
    """Return the cost of a scene with a feature, and the difference from the scene without it, in ns.

    Both are measured over turns of `blocks` blocks in all; the poses change with the touched surface.
    """
    scenes = feature.without, feature.having
    if feature.poses is not None:
        poses = feature.poses()
    elif keep_contact(feature.without).object[0] == keep_contact(feature.having).object[0]:
        poses = (make_touching_poses(feature.without),) * 2
    else:
        poses = make_touching_poses(feature.without), make_touching_poses(feature.having)
    units, (without, having) = measure_in_turns(list(zip(scenes, poses, strict=True)), blocks)
    before, after = np.array([cost.median_ns for cost in without]), np.array([cost.median_ns for cost in having])
    return {
        "feature": feature.name,
        "base": feature.base,
        "ns_per_step": find_quietest(after),
        "base_ns_per_step": find_quietest(before),
        "marginal_ns": float(np.median(after - before)),
        "reference_ns": find_quietest(units),
        "in_contact": having[0].in_contact,
    }


def format_table(result: dict[str, Any]) -> list[str]:
    lines = [f"contact step, back to back; ratio to a chain of {REFERENCE_OPERATIONS} dependent operations"]
    for scene in result["scenes"]:
        lines.append(str(scene["scene"]))
        for row in scene["variants"]:
            cost, unit = row["ns_per_step"], row["reference_ns"]
            marginal = f" {row['marginal_ns']:+8.1f} ns" if "marginal_ns" in row else ""
            lines.append(
                f"  {row['variant']:<46}{cost:8.1f} ns {cost / unit:7.3f} of {unit:.0f} ns, "
                f"thread {row['cpu_ns_per_step']:.1f} ns{marginal}"
            )
    if "features" in result:
        lines.append("cost of a feature, and the scene it is added to")
        for row in result["features"]:
            cost, unit = row["ns_per_step"], row["reference_ns"]
            lines.append(
                f"  {row['feature']:<46}{cost:8.1f} ns {cost / unit:7.3f} of {unit:.0f} ns "
                f"{row['marginal_ns']:+8.1f} ns  {row['base']}"
            )
    return lines


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw the variants of the scenes and, below them, the cost of each feature."""
    steps = [(f"{s['scene']}: {row['variant']}", row["ns_per_step"]) for s in result["scenes"] for row in s["variants"]]
    added = [(row["feature"], row["marginal_ns"]) for row in result.get("features", [])]
    parts = [(rows, axis) for rows, axis in ((steps, "ns per step, back to back"), (added, "ns added")) if rows]
    drawing = make_figure(height=len(parts) + 0.3 * (len(steps) + len(added)))
    grid = drawing.subplots(len(parts), 1, squeeze=False, height_ratios=[1 + len(rows) for rows, _ in parts])
    for axes, (rows, axis) in zip(grid[:, 0], parts, strict=True):
        axes.barh([label for label, _ in rows][::-1], [cost for _, cost in rows][::-1])
        axes.set_xlabel(axis)
    save(drawing, path)
