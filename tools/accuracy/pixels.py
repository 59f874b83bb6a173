"""`accuracy --heightmap`: hills from an array of heights, as a height map and as a shaded mesh of the same pixels.

The hills z = A cos(k x) cos(k y) have an equation, so the path of a rolling fingertip on them is known to the eighth
order. The fingertip is moved along it on both objects and compared with it, as `accuracy --meshes` does for a ball.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.proxy.engine import Engine
from softfinger.server.offline.figures import make_figure, save
from softfinger.server.progress import map_with_progress
from softfinger.tools.accuracy import meshes
from softfinger.tools.accuracy.reference import Hills, compute_normal_and_curvature
from softfinger.tools.measure import Array, show_and_draw

HILLS: Final = Hills(0.004, 0.06)
"""The smallest radius of curvature of their valleys is 23 mm."""
START_M: Final = (0.003, 0.002)
"""Start of the paths: x and y."""
SIDE_M: Final = 0.12
PITCHES_M: Final = (0.004, 0.002, 0.001, 0.0005)
KINDS: Final = ("heightmap", "mesh")
MEASURES: Final = ("force_n", "direction_rad", "rolled_m", "wound_m")
PASSES: Final = 3
"""Repetitions of the most expensive run; the shortest counts."""


def make_paths(ticks: int) -> list[meshes.LedPath]:
    foot = np.array([*START_M, HILLS.height(*START_M)])
    normal, _ = compute_normal_and_curvature(foot, HILLS)
    return [meshes.make_lead_path(HILLS, foot, normal, heading, ticks) for heading in meshes.HEADINGS_RAD]


def make_grid(pitch: float) -> tuple[Array, Array, Array]:
    """Return x and y of the pixels and their heights, (n, n) m each: columns along x, origin in the middle."""
    count = round(SIDE_M / pitch)
    at = pitch * (np.arange(count + 1) - 0.5 * count)
    x, y = np.meshgrid(at, at)
    return x, y, np.asarray(HILLS.height(x, y))


def make_object(kind: str, pitch: float, folder: Path) -> dict[str, Any]:
    """Return the object of a scene; a mesh has two triangles for each square."""
    x, y, z = make_grid(pitch)
    if kind == "heightmap":
        np.save(folder / "hills.npy", z)
        return {"shape": "heightmap", "file": str(folder / "hills.npy"), "pitch_m": pitch, "level_m": 1.0}
    vertices, triangles = meshes.triangulate_grid(np.stack([x, y, z], axis=2).transpose(1, 0, 2))
    return {"shape": "mesh", "file": meshes.save_mesh(folder, vertices, triangles), "shading": "normals"}


def compare(kind: str, pitch: float, led_paths: Sequence[meshes.LedPath]) -> dict[str, Any]:
    """Return the largest differences from the hills on all paths, and the cost of a tick that rolls, us."""
    with tempfile.TemporaryDirectory() as folder:
        obj = make_object(kind, pitch, Path(folder))
        smooth, rolls = (Engine(meshes.make_scene(obj, sticks)) for sticks in (False, True))
    rows, cost_us = [], []
    for path in led_paths:
        records = meshes.visit(smooth, path)
        rows.append(meshes.find_differences(path, records, records, meshes.visit(rolls, path)))
        for _ in range(PASSES):
            rolls.reset()
            start = time.perf_counter()
            rolls.run(path.poses)
            cost_us.append(1e6 * (time.perf_counter() - start) / len(path.poses))
    largest = {key: max(row[key] for row in rows) for key in MEASURES}
    return {"kind": kind, "pitch_m": pitch, **largest, "tick_us": min(cost_us)}


def run(args: argparse.Namespace) -> int:
    led_paths = make_paths(meshes.TICKS)
    cases = [(kind, pitch) for pitch in PITCHES_M for kind in KINDS]
    rows = map_with_progress("hills of pixels", lambda case: compare(*case, led_paths), cases)
    return show_and_draw(args, {"rows": rows}, format_lines(rows), lambda path: draw(rows, path))


def format_lines(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield "largest differences from the hills; microseconds of a tick that rolls"
    for row in rows:
        errors = "  ".join(f"{key} {row[key]:.1e}" for key in MEASURES)
        yield f"{row['kind']:9} pitch {1e3 * row['pitch_m']:4.1f} mm  {errors}  tick {row['tick_us']:.1f} us"


def draw(rows: Sequence[dict[str, Any]], file: Path) -> None:
    """Draw a panel for each measure: both kinds against the pitch."""
    drawing = make_figure(10.0, 3.5)
    for axes, key in zip(drawing.subplots(1, len(MEASURES), sharex=True), MEASURES, strict=True):
        for kind in KINDS:
            of_kind = [row for row in rows if row["kind"] == kind]
            axes.loglog([1e3 * row["pitch_m"] for row in of_kind], [row[key] for row in of_kind], "o-", label=kind)
        axes.set(title=key, xlabel="pitch, mm")
        axes.legend(fontsize="x-small")
    save(drawing, file)
