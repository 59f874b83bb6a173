"""Hostile height maps next to other objects and in many rolling steps: proxy outside, bounded forces, bounded
queries."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from helpers import counted_asks, meshes
from helpers.hostile_maps import MADE, STIFFNESS, hands, outside_by, part
from helpers.programs import run_program
from helpers.touching import SMOOTH, Array, R, engine, make_object, posed, spun, wander, write_part
from references.brute_force import balls_of, brute_distances

from softfinger.proxy.heightmaps import compile_heightmap
from softfinger.proxy.record import ON_ITS_WAY, UNSEARCHED

pytestmark = [pytest.mark.plain, pytest.mark.scaled]
Cases = Callable[[int, int], int]
INSIDE: Final = 1e-9
"""Tolerance for the proxy inside an object, relative to the radius."""
TILTED: Final = (0.9238795325112867, 0.3826834323650898, 0.0, 0.0)
"""Rotation by 45 degrees about x."""
COMPANY: Final = ("plane", "ball", "mesh", "map")


def companion(kind: str, folder: Path, heights: Array, pitch: float, **keys: Any) -> dict[str, Any]:
    """Another object that protrudes from the map: a slope, a half sphere or mesh, the same map tilted."""
    half, low, high = 0.5 * pitch * max(heights.shape), float(heights.min()), float(heights.max())
    size = max(R, 0.3 * half)
    if kind == "plane":
        return make_object("other", "plane", position_m=[0.2 * half, 0.0, high], orientation_wxyz=list(TILTED), **keys)
    if kind == "ball":
        return make_object("other", "sphere", radius_m=size, position_m=[0.0, 0.0, low], **keys)
    if kind == "mesh":
        return make_object("other", "mesh", file=write_part(folder, *bumpy(size)), position_m=[0.0, 0.0, low], **keys)
    made = part(folder, heights, pitch, orientation_wxyz=list(TILTED), position_m=[0.0, 0.3 * half, high], **keys)
    return made | {"name": "other"}


def bumpy(size: float) -> meshes.Mesh:
    return meshes.bumpy_sphere(16, size, height=0.06)


def turned_back(centers: Array) -> Array:
    half = np.sqrt(0.5)
    x, y, z = centers.T
    return np.stack([x, half * (y + z), half * (z - y)], axis=1)


def outside_of_companion(kind: str, made: dict[str, Any], heights: Array, pitch: float, centers: Array) -> float:
    """Smallest distance (m) of the fingertip's centres (n, 3) from the companion, less the radius."""
    at = centers - np.asarray(made["position_m"])
    if kind == "plane":
        return float(turned_back(at)[:, 2].min()) - R
    if kind == "ball":
        return float(np.linalg.norm(at, axis=1).min()) - made["radius_m"] - R
    if kind == "mesh":
        size = max(R, 0.15 * pitch * max(heights.shape))
        return float(brute_distances(balls_of(*bumpy(size)), at).min()) - R
    return outside_by(compile_heightmap(heights, pitch), turned_back(at))


def path_over(heights: Array, pitch: float, count: int) -> Array:
    """Path through the first `count` points of each of `hands`, each started from above all objects."""
    up = np.array([[0.0, 0.0, heights.max() + 3.0 * R + 2.0 * np.ptp(heights) + pitch * max(heights.shape)]])
    return np.vstack([rows for points in hands(heights, pitch).values() for rows in (up, points[:count])])


def select_maps(cases: Cases, *numbers: int) -> list[str]:
    """Return the map names of these indices, which differ between tests; all names with --exhaustive."""
    names = list(MADE)
    return [names[number] for number in (range(len(names)) if cases(0, 1) else numbers)]


def check_touches(folder: Path, kind: str, names: list[str], count: int, **keys: Any) -> None:
    """Drag, throw and press on maps next to such an object; check that the proxy is finite and outside of both. Without
    friction the force is at most three times the spring force, one for each of three contacts."""
    for name in names:
        pitch, heights = MADE[name]()
        points, tables = path_over(heights, pitch, count), {"rolling": None} if keys else {}
        poses = posed(points, spun((0.0, 0.6, 0.8), np.sin(0.05 * np.arange(len(points)))))
        (folder / name).mkdir()
        neighbour = companion(kind, folder, heights, pitch, **keys)
        records = engine(part(folder / name, heights, pitch, **keys), neighbour, **tables).run(poses)
        centers = records["proxy.position"][records["contact.mode"] > 0]
        assert len(centers) > 0.1 * len(points) and np.isfinite(np.asarray(records)).all()
        assert outside_by(compile_heightmap(heights, pitch), centers) >= -INSIDE * R, name
        assert outside_of_companion(kind, neighbour, heights, pitch, centers) >= -INSIDE * R, name
        if keys:
            depth = np.linalg.norm(records["proxy.position"] - records["probe.position"], axis=1)
            force = np.linalg.norm(records["force"], axis=1)
            assert (force <= 3.0 * STIFFNESS * depth * (1.0 + 1e-9) + 1e-12).all(), name
        assert set(np.unique(records["contact.budget"])) <= {0, UNSEARCHED, ON_ITS_WAY}


BESIDE: Final = {"plane": (2, 6), "ball": (3, 7), "mesh": (0, 5), "map": (4, 1)}
"""Indices of the maps tested with each companion unless all are tested with all."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", COMPANY)
def test_hostile_maps_next_to_another_object(tmp_path: Path, cases: Cases, kind: str) -> None:
    """Without friction, which displaces the recorded proxy."""
    check_touches(tmp_path, kind, select_maps(cases, *BESIDE[kind]), cases(10, 150), material=SMOOTH)


def test_hostile_maps_next_to_a_plane_with_friction(tmp_path: Path, cases: Cases) -> None:
    check_touches(tmp_path, "plane", select_maps(cases, 5, 8), cases(10, 150))


def test_hostile_maps_with_many_rolling_steps(tmp_path: Path, cases: Cases) -> None:
    for name in select_maps(cases, 2, 6, 8):
        pitch, heights = MADE[name]()
        folder = tmp_path / name
        folder.mkdir()
        points = path_over(heights, pitch, cases(10, 150))
        ticks = np.arange(len(points))
        poses = posed(points, spun((0.6, 0.0, 0.8), 0.5 * ticks * np.sin(0.02 * ticks)))
        records = engine(part(folder, heights, pitch), rolling={"method": "montana_rk45"}).run(poses)
        centers = records["proxy.position"][records["contact.mode"] > 0]
        assert len(centers) > 0.1 * len(points) and np.isfinite(np.asarray(records)).all()
        assert outside_by(compile_heightmap(heights, pitch), centers) >= -INSIDE * R, name


def test_queries_of_a_tick_stay_within_the_budget(tmp_path: Path, cases: Cases) -> None:
    """Lookups are counted in plain Python on hostile maps: single maps with montana_rk45, and pairs of objects. Without
    counting, in `make test-all` compiled, the same ticks give the same proxies."""
    scenes, most = [], []
    for situation in ("alone", "map", *(("plane", "ball") if cases(0, 1) else ())):
        for name in select_maps(cases, 3, 6, 7):
            pitch, heights = MADE[name]()
            folder = tmp_path / situation / name
            (folder / "other").mkdir(parents=True)
            objects = [part(folder, heights, pitch)]
            if situation != "alone":
                objects.append(companion(situation, folder / "other", heights, pitch))
            method = "montana_rk45" if situation == "alone" else "midpoint"
            scenes.append((method, objects, path_over(heights, pitch, 150)[:: cases(27, 9)].tolist()))
            most.append(counted_asks.ALONE if situation == "alone" else counted_asks.IN_COMPANY)
    options = {"cwd": Path(counted_asks.__file__).parents[1], "env": os.environ | {"NUMBA_DISABLE_JIT": "1"}}
    command = [sys.executable, "-m", "helpers.counted_asks"]
    output = run_program(command, input=json.dumps(scenes), check=True, timeout=1200, **options).stdout
    for bound, (method, objects, points), (lookups, centers) in zip(most, scenes, json.loads(output), strict=True):
        assert 0 < max(lookups) <= bound
        records = engine(*objects, rolling={"method": method}).run(counted_asks.poses_at(points))
        np.testing.assert_allclose(records["proxy.position"], centers, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("seed", "radius"), [(26, 0.005), (5, 0.002)])
def test_a_map_that_swings_past_the_finger_next_to_a_mesh(tmp_path: Path, seed: int, radius: float) -> None:
    """Relative to the map, the fingertip touches it on its path, and is out of reach at the end of the tick."""
    x = 1e-3 * (np.arange(40) - 19.5)
    axis = np.random.default_rng(seed).normal(size=3).tolist()
    swing = {"kind": "sinusoid", "axis": axis, "rotation_rad": 1.0, "frequency_hz": 90.0}
    heights = 5e-3 * np.cos(200.0 * x[:, None]) * np.cos(170.0 * x)
    hills = part(tmp_path, heights, 1e-3, motion=swing, material=SMOOTH)
    file = write_part(tmp_path, *meshes.geodesic(3, 0.03))
    ball = make_object("ball", "mesh", file=file, position_m=[0.0, 0.0, 0.045], material=SMOOTH)
    points = wander(seed, 120, 0.015, 2e-4) + np.array([0.0, 0.0, 0.012])
    records = engine(hills, ball, fingertip={"radius_m": radius}, rolling=None).run(posed(points))
    assert np.isfinite(np.asarray(records)).all() and (records["contact.mode"] > 0).any()
