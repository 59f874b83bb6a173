"""The program that checks meshes accepts correct ones and detects errors."""

import json
import sys
from pathlib import Path

import mesh_truth
import numpy as np
import pytest
from helpers import meshes
from helpers.programs import run_program
from helpers.surface_hand import hand
from helpers.touching import R, make_object, scene_with, write_part
from references.brute_force import balls_of, brute_distances
from references.triangles import distances

from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.scene import build_scene

SCRIPT = Path(__file__).parents[1] / "mesh_truth.py"


@pytest.mark.exhaustive
def test_a_ball_is_true(tmp_path: Path) -> None:
    """Distances to 1e-9 of its size, and a proxy that is never inside; exit code 0."""
    words = ["ball", "--points", "300", "--ticks", "1000"]
    result = json.loads(run_program((sys.executable, str(SCRIPT), *words), check=True).stdout)["ball"]
    assert result["distances"]["points"] == 300 and result["distances"]["error"] < 1e-9
    assert result["hand"]["touching"] > 100 and result["hand"]["inside"] == result["hand"]["through"] == 0


def test_a_proxy_inside_a_mesh_is_detected(tmp_path: Path) -> None:
    ball = meshes.geodesic(8, 0.05)
    scene = scene_with(make_object("part", "mesh", file=write_part(tmp_path, *ball)))
    true, larger = balls_of(*ball), balls_of(1.01 * ball.vertices, ball.triangles)
    rng = np.random.default_rng(0)
    ticks = mesh_truth.check_ticks(scene, true, hand(ball, 500, R, rng), R)
    away = mesh_truth.check_distances(scene, true, 200, rng)
    assert ticks["touching"] > 50 and not mesh_truth.is_wrong({"hand": ticks, "distances": away})
    result = mesh_truth.check_ticks(scene, larger, hand(ball, 500, R, rng), R)
    assert result["inside"] > 0 and result["deepest"] > 0.01 and mesh_truth.is_wrong({"hand": result})
    assert mesh_truth.check_distances(scene, larger, 200, rng)["error"] > 1e-3


def test_a_position_that_is_not_a_number_is_near_nothing(tmp_path: Path) -> None:
    """Compiled: a comparison with NaN is false, so the search would accept all boxes, also the empty ones."""
    part = make_object("part", "mesh", file=write_part(tmp_path, *meshes.geodesic(8, 0.05)))
    mesh = build_scene(scene_with(part)).objects.body
    values = [(x, y, z) for x in (0.0, np.nan, np.inf) for y in (0.1, np.nan) for z in (0.0, -np.inf, np.nan)]
    points = np.array([value for value in values if not np.isfinite(value).all()])
    results = np.zeros((len(points), 3))
    mesh_truth.ask(mesh.shape, flatten(mesh.shape), points, BUDGET, results)
    assert np.all(results[:, :2] > 1.0) and not results[:, 2].any()


def test_a_path_through_a_sheet_is_detected() -> None:
    balls = balls_of(*meshes.sheet(0.1, 0.1, 3, 3))
    over, under, away = np.array([0.05, 0.05, 0.03]), np.array([0.05, 0.04, -0.04]), np.array([0.2, 0.05, 0.03])
    assert mesh_truth.goes_through(balls, over, under, R) and not mesh_truth.goes_through(balls, over, away, R)


def test_pruned_search_equals_brute_force() -> None:
    """The compiled and pruned search equals numpy's over all triangles, to rounding."""
    bumpy = meshes.bumpy_sphere(12, 0.05, height=0.06)
    points = 0.05 * np.random.default_rng(1).normal(size=(300, 3))
    expected = [distances(*bumpy, x).min() for x in points]
    np.testing.assert_allclose(brute_distances(balls_of(*bumpy), points), expected, rtol=0.0, atol=1e-16)
