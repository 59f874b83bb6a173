"""Extreme height maps and hand motions: the proxy stays outside, forces stay bounded, and queries within a budget.

Compiled, which takes half a minute: each case has thousands of ticks, whose queries would take minutes in plain Python.
All cases share one type of scene.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from helpers.hostile_maps import MADE, STIFFNESS, hands, outside_by, part, surface
from helpers.touching import SLIPPERY, R, engine, posed, spun
from numpy.typing import NDArray

from softfinger.proxy.engine import Engine
from softfinger.proxy.heightmaps import compile_heightmap
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes import closest_or_bound
from softfinger.proxy.kernels.shapes.heightmap.nearest import (
    HEIGHT_COST,
    QUERY_BUDGET,
    compute_gap_within,
    find_nearest_from,
)
from softfinger.proxy.kernels.shapes.heightmap.surface import MAX_EVALUATIONS
from softfinger.proxy.kernels.shapes.heightmap.tiles import MAX_LEVELS

Array = NDArray[np.float64]

LAST: Final = HEIGHT_COST * (5 + 2 * MAX_EVALUATIONS) + 4 * MAX_LEVELS
"""Number of lookups that a query may exceed its budget by: the current cell and the tiles on the way out."""


@entry
def ask(shape: Any, points: Any, radius: float, results: Any) -> None:
    """Fill `found` (n, 4) with the cost of nearest and limited-gap queries, the gap, and the nearest point's error."""
    for k in range(len(points)):
        x = (points[k, 0], points[k, 1], points[k, 2])
        results[k, 0] = find_nearest_from(shape, x, x, QUERY_BUDGET).cost
        results[k, 1] = compute_gap_within(shape, x, radius, QUERY_BUDGET).cost
        gap, point, normal, _ = closest_or_bound(shape, x)
        results[k, 2] = gap
        off = vec3.sub(vec3.add_scaled(point, gap, normal), x)
        results[k, 3] = vec3.norm(off)


def is_safe(running: Engine, shape: Any, points: Array, smooth: bool) -> Array:
    records = running.run(posed(points, spun((0.0, 0.6, 0.8), np.sin(0.05 * np.arange(len(points))))))
    touches = records["contact.mode"] > 0
    assert np.isfinite(np.asarray(records)).all()
    if touches.any():
        assert outside_by(shape, records["proxy.position"][touches]) >= -1e-9 * R
    if smooth:  # friction displaces the recorded proxy
        depth = np.linalg.norm(records["proxy.position"] - records["probe.position"], axis=1)
        assert (np.linalg.norm(records["force"], axis=1) <= STIFFNESS * depth * (1.0 + 1e-9) + 1e-12).all()
    assert set(np.unique(records["contact.budget"])) <= {0.0, 1.0}
    return np.asarray(touches)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", MADE)
def test_it_is_touched_safely(tmp_path: Path, name: str) -> None:
    """Dragged, pressed and thrown from outside: finite, outside of the map, with a force of at most K times the depth.
    Holds with and without friction."""
    pitch, heights = MADE[name]()
    shape, met = compile_heightmap(heights, pitch), False
    for smooth in (True, False):
        keys = {"material": SLIPPERY} if smooth else {}
        running = engine(part(tmp_path, heights, pitch, **keys))
        for points in hands(heights, pitch).values():
            running.reset()
            path = np.vstack([[0.0, 0.0, heights.max() + 3.0 * R + np.ptp(heights)], points])
            met |= bool(is_safe(running, shape, path, smooth).any())
    assert met


@pytest.mark.parametrize("name", ["noise", "high noise", "steps", "pit"])
def test_the_first_pose_may_be_deep_inside(tmp_path: Path, name: str) -> None:
    pitch, heights = MADE[name]()
    points = np.tile([0.3 * pitch * len(heights), 0.0, heights.min() - 3.0 * R], (20, 1))
    running = engine(part(tmp_path, heights, pitch, material=SLIPPERY))
    assert is_safe(running, compile_heightmap(heights, pitch), points, True).all()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", MADE)
def test_no_query_exceeds_its_budget(name: str) -> None:
    pitch, heights = MADE[name]()
    shape, rng = compile_heightmap(heights, pitch), np.random.default_rng(6)
    spread = np.array([*[0.5 * pitch * max(heights.shape)] * 2, R])
    points = rng.uniform(-1.0, 1.0, (60, 3)) * spread + (0.0, 0.0, heights.max() + R)
    points = np.vstack([points, 0.01 * R * rng.normal(size=(60, 3))])
    results = np.zeros((len(points), 4))
    ask(shape, points, R, results)
    assert results[:, :2].max() <= QUERY_BUDGET + LAST
    assert results[results[:, 2] >= 0.0, 3].max() <= 1e-12
    places = surface(shape, 3e-3)
    for x, gap in zip(points, results[:, 2], strict=True):
        assert abs(gap) <= np.linalg.norm(places - x, axis=1).min() * (1.0 + 1e-12)


def test_a_tight_pit_exhausts_the_budget_and_stays_stable(tmp_path: Path) -> None:
    pitch, heights = MADE["pit"]()
    running = engine(part(tmp_path, heights, pitch, material=SLIPPERY))
    records = running.run(posed(np.vstack([[0.0, 0.0, 3.0 * R], hands(heights, pitch)["middle"]])))
    stays = np.flatnonzero((records["contact.budget"][1:] == 1) & (records["contact.mode"][:-1] > 0)) + 1
    assert len(stays) > 10
    moved = np.linalg.norm(np.diff(records["proxy.position"], axis=0), axis=1)[stays - 1]
    assert np.median(moved) == 0.0
