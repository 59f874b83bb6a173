"""`bench mesh`: cost of a tick on a mesh, by its size, smooth and bumpy, compared with a ball of the same size."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import flatten, packed, unpack
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.kernels.shapes.mesh.contact import NO_TRIANGLE
from softfinger.proxy.kernels.shapes.mesh.nearest import find_nearest
from softfinger.proxy.kernels.shapes.mesh.triangle import find_foot_on, read_corners
from softfinger.proxy.scene import build_scene, start_state
from softfinger.server.loop.clock import make_stopwatch
from softfinger.server.offline.cost import time_steps
from softfinger.server.progress import show_progress
from softfinger.tools.bench.features import GRIP
from softfinger.tools.measure import Array, compute_quantiles, draw_lines, show_and_draw

RADIUS_M: Final = 0.05
"""Radius of the ball."""
BUMPS_M: Final = 0.001
DEPTH_M: Final = 0.001
SPEED_M: Final = 1e-4
"""Distance of the fingertip per tick: 0.1 m/s."""
BLOCK: Final = 1000
CHECKED_POINTS: Final = 20
"""Points at which the distance is compared with a search over all triangles."""


def run(args: argparse.Namespace) -> int:
    cases = [(level, bumpy, r) for level in args.levels for bumpy in (False, True) for r in args.fingertip]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, show_progress("measuring meshes", len(cases)) as advance:
        for level, bumpy, radius in cases:
            file, vertices, triangles = write_ball(Path(folder), level, BUMPS_M if bumpy else 0.0)
            start_s = time.perf_counter()
            scene = make_scene(radius, shape="mesh", file=file)
            row = {"triangles": len(triangles), "bumpy": bumpy, "fingertip_m": radius}
            row["loaded_s"] = time.perf_counter() - start_s
            rows.append(row | measure_ticks(scene, radius, args) | count_visits(scene, vertices[triangles], radius))
            advance(len(rows))
        spheres = [measure_ticks(make_scene(r, shape="sphere", radius_m=RADIUS_M), r, args) for r in args.fingertip]
    result = {
        "rows": rows,
        "sphere": [{"fingertip_m": r} | row for r, row in zip(args.fingertip, spheres, strict=True)],
    }
    return show_and_draw(args, result, format_table(result), lambda path: draw(result, path))


def write_ball(folder: Path, level: int, bumps: float) -> tuple[str, Array, Array]:
    """Write a ball of 20 x 4^level triangles, smooth or bumpy; returns file, vertices (n, 3) m and triangles (m, 3)."""
    try:
        import trimesh
    except ImportError as error:
        raise ConfigError(f"bench mesh needs trimesh: pip install 'softfinger[mesh]' ({error})") from error
    sphere = trimesh.creation.icosphere(subdivisions=level, radius=1.0)
    x = np.asarray(sphere.vertices)
    waves = np.sin(30.0 * x[:, 0]) * np.sin(30.0 * x[:, 1]) * np.cos(20.0 * x[:, 2])
    sphere.vertices = x * (RADIUS_M + bumps * waves)[:, None]
    file = folder / f"{level}-{bumps:g}.ply"
    if not file.exists():
        sphere.export(file)
    return str(file), np.asarray(sphere.vertices), np.asarray(sphere.faces)


def make_scene(radius: float, **shape: Any) -> schema.Scene:
    obj = {"name": "ball", "material": GRIP, **shape}
    coupling = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 1.0}
    tables = {"fingertip": {"radius_m": radius}, "rolling": {"method": "midpoint"}, "coupling": coupling}
    return build(schema.Scene, {**tables, "object": [obj]}, "bench mesh")


def make_path(ticks: int, radius: float) -> Array:
    """Return poses (ticks, 7) of a fingertip that is pressed in, dragged over the ball and turned."""
    rng, reach = np.random.default_rng(0), RADIUS_M + radius
    x, along = np.array([0.0, 0.0, 1.0]), rng.normal(size=3)
    poses = np.zeros((ticks, 7))
    for k in range(ticks):
        if k % 500 == 0:
            along = rng.normal(size=3)
        x = x + SPEED_M / reach * along / np.linalg.norm(along)
        x /= np.linalg.norm(x)
        poses[k, :3] = x
    poses[:, :3] *= (reach - DEPTH_M * np.minimum(np.arange(ticks) / 200.0, 1.0))[:, None]
    half = 0.5 * np.sin(np.arange(ticks) * 2e-3)
    poses[:, 3], poses[:, 4:6] = np.cos(half), np.sin(half)[:, None] * (0.6, 0.8)
    return poses


def measure_ticks(scene: schema.Scene, radius: float, args: argparse.Namespace) -> dict[str, Any]:
    """Measure the time of single ticks, ns: back to back, paced, and in free motion."""
    tree = build_scene(scene)
    parameters, poses = packed(tree), make_path(args.ticks, radius)
    paced = make_path(args.paced, radius)
    away = poses.copy()
    away[:, :3] *= 1.3
    costs: dict[str, Any] = {}
    watch = make_stopwatch(1, BLOCK)  # a thousand intervals without a pose: the cost of reading the clock
    time_steps(parameters, packed(start_state(tree)), poses[:1], 0.001, watch, np.zeros(1, np.int64))
    clock = float(np.median(watch.ns))
    for name, along, apart_ns in (("touching", poses, 0), ("free", away, 0), ("paced", paced, 1_000_000)):
        watch = make_stopwatch(1, len(along))
        time_steps(parameters, packed(start_state(tree)), along, 0.001, watch, np.zeros(1, np.int64), apart_ns)
        ns = watch.ns[0].astype(np.float64) - clock
        costs[f"{name}_ns"] = compute_quantiles(ns[BLOCK // 2 :], BLOCK)
    return costs


@entry
def find_nearest_triangles(like: Any, values: Array, points: Array, visits: Array) -> None:
    """Store in `visits` (n, 3) the results for each of `points` (n, 3) m.

    The columns are the squared distance, the number of nodes and triangles visited and, for the first CHECKED_POINTS,
    the squared distance over all triangles.
    """
    mesh = unpack(like, values)
    triangles = mesh.row[0]
    for i in range(len(points)):
        x = (points[i, 0], points[i, 1], points[i, 2])
        near = find_nearest(mesh, x, 1e300, NO_TRIANGLE, BUDGET, 0.0)
        visits[i, 0], visits[i, 1], visits[i, 2] = near.squared_distance, near.visits, 1e300
        if i < CHECKED_POINTS:
            for k in range(int(triangles.triangle_count)):
                visits[i, 2] = min(visits[i, 2], find_foot_on(read_corners(triangles, k), x).squared_distance)


def count_visits(scene: schema.Scene, corners: Array, radius: float) -> dict[str, Any]:
    """Return the nodes and triangles visited for the nearest one, and the largest error of the distance."""
    mesh = build_scene(scene).objects.body.shape
    points = np.ascontiguousarray(make_path(BLOCK, radius)[:, :3])
    nearest = np.zeros((len(points), 3))
    find_nearest_triangles(mesh, flatten(mesh), points, nearest)
    wrong = np.abs(np.sqrt(nearest[:CHECKED_POINTS, 0]) - np.sqrt(nearest[:CHECKED_POINTS, 2])).max()
    percentiles_s = [float(np.percentile(nearest[:, 1], at)) for at in (50, 99, 100)]
    return {"asked": dict(zip(("p50", "p99", "max"), percentiles_s, strict=True)), "distance_error_m": float(wrong)}


def format_table(result: dict[str, Any]) -> Iterator[str]:
    yield "a tick with friction, torsion and rolling, us: p50 / p99 / p99.9"
    yield "asked: nodes and triangles for the nearest one"
    for row in result["rows"]:
        name = f"{row['triangles']:>9,} {'bumpy' if row['bumpy'] else 'smooth'}"
        asked_of = f"asked {row['asked']['p50']:.0f} / {row['asked']['p99']:.0f}"
        yield f"{name:17}{_format_line(row)}  {asked_of}, off by {row['distance_error_m']:.1e} m"
    for row in result["sphere"]:
        yield f"{'the ball itself':17}{_format_line(row)}"


def _format_line(row: dict[str, Any]) -> str:
    parts = [f"r {1000.0 * row['fingertip_m']:4.1f} mm"]
    for name in ("touching", "paced", "free"):
        cost = row[f"{name}_ns"]
        parts.append(f"{name} " + " / ".join(f"{cost[at] / 1000.0:.2f}" for at in ("p50", "p99", "p999")))
    return "  ".join(parts)


def draw(result: dict[str, Any], file: Path) -> None:
    lines = {}
    for bumpy in (False, True):
        rows = sorted((r for r in result["rows"] if r["bumpy"] == bumpy), key=lambda row: row["triangles"])
        for at in ("p50", "p99"):
            costs = [row["touching_ns"][at] / 1000.0 for row in rows]
            lines[f"{'bumpy' if bumpy else 'smooth'}, {at}"] = [row["triangles"] for row in rows], costs
    draw_lines(file, lines, "triangles", "us per tick, back to back", style="o-", log=True)
