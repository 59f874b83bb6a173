"""Measurement of one case of `softfinger accuracy`: path error against the reference, and time of a step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import ceil
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.proxy.kernels.contact.rolling import OffsetPoint, roll
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.shapes import closest
from softfinger.server.loop.clock import Stopwatch, make_stopwatch, read_clock_ns
from softfinger.tools.accuracy.cases import (
    METHODS,
    RADIUS_M,
    RollingCase,
    compute_angular_velocity,
    compute_orientations,
    compute_ratio,
    compute_turns,
    count_ticks,
    make_contact,
)
from softfinger.tools.accuracy.reference import roll_path
from softfinger.tools.bench.step import measure_reference_ns
from softfinger.tools.measure import Array
from softfinger.tools.options import DRIFT_BLOCK

BLOCK_STEPS: Final = 1000
"""Smallest number of steps between two readings of the clock, which then cost less than 0.1 ns per step."""
DRIFT_STEP_RAD: Final = 0.01


@entry
def roll_turns(
    method: Any, shape: Any, radius: float, start: OffsetPoint, turns: Array, passes: int, path: Array, watch: Stopwatch
) -> None:
    """Roll through `compute_turns` (n, 4) from one contact, `passes` times for each block of `watch`.

    Every step stores centre, normal and total spin in a row of `path` (n, 7), as a servo stores a record.
    """
    for block in range(watch.ns.shape[0]):
        start_ns = read_clock_ns(watch.timespec)
        for _ in range(passes):
            center, n, spin = start.center, start.normal, 0.0
            for i in range(turns.shape[0]):
                out = roll(method, shape, radius, center, n, (turns[i, 0], turns[i, 1], turns[i, 2], turns[i, 3]))
                center, n, spin = out.center, out.normal, spin + out.spin
                path[i, 0], path[i, 1], path[i, 2] = center
                path[i, 3], path[i, 4], path[i, 5] = n
                path[i, 6] = spin
        watch.ns[block] = read_clock_ns(watch.timespec) - start_ns


class RollResult(NamedTuple):
    """Contact points (n, 3) m, normals (n, 3), spins (n,) rad, and the median time of a step, ns."""

    points: Array
    normals: Array
    spins: Array
    step_ns: float


def roll_path_timed(method: Any, shape: Any, center: Any, normal: Any, dq: Array, passes: int = 1) -> RollResult:
    """Return the path of the fingertip through the rotations `dq` (n, 4), timed in `passes` blocks."""
    path, repeats = np.zeros((len(dq), 7)), ceil(BLOCK_STEPS / len(dq)) if passes > 1 else 1
    watch = make_stopwatch(passes)
    roll_turns(method, shape, RADIUS_M, OffsetPoint(center, normal), dq, repeats, path, watch)
    points = path[:, :3] - RADIUS_M * path[:, 3:6]
    return RollResult(points, path[:, 3:6], path[:, 6], float(np.median(watch.ns)) / (repeats * len(dq)))


@lru_cache(maxsize=16)
def integrate_reference(case: RollingCase) -> tuple[Array, Array]:
    """Return contact points (n, 3) m and spins (n,) rad of the reference after each step; `case` has no method."""
    times = step_times(case)
    points, _, spins = _integrate_path(case._replace(rate_hz=0.0), float(times[-1])).at(times[1:])
    return points, spins


@lru_cache(maxsize=4)
def _integrate_path(case: RollingCase, duration_s: float) -> Any:
    """Return the path, the same at all servo rates."""
    shape, center, normal = make_contact(case.surface, case.curvature_ratio)
    # The normal turns with the finger at r / (r + R) of its rate; in a cavity that it nearly fills, much faster.
    ratio = compute_ratio(case.surface, case.curvature_ratio)
    faster = ratio / (1.0 - ratio) if getattr(shape, "side", 1.0) < 0.0 else 0.0
    steps = ceil(20.0 * case.turn_rate * duration_s * max(1.0, faster))
    return roll_path(shape, RADIUS_M, center, normal, compute_angular_velocity(case, normal), duration_s, steps)


def step_times(case: RollingCase) -> Array:
    count = count_ticks(case)
    return np.linspace(0.0, count / case.rate_hz, count + 1)


def run_case(case: RollingCase) -> dict[str, Any]:
    shape, center, normal = make_contact(case.surface, case.curvature_ratio)
    dq = compute_turns(compute_orientations(case, normal, step_times(case)))
    points, spins = integrate_reference(case._replace(method="", passes=0))
    unit = measure_reference_ns()
    rolled = roll_path_timed(METHODS[case.method], shape, center, normal, dq, case.passes)
    return {
        "surface": case.surface,
        "method": case.method,
        "motion": case.motion,
        "step_s": 1.0 / case.rate_hz,
        "rate_hz": case.rate_hz,
        "turn_rate_rad_per_s": case.turn_rate,
        "step_angle_rad": case.turn_rate / case.rate_hz,
        "curvature_ratio": compute_ratio(case.surface, case.curvature_ratio),
        "given_ratio": case.curvature_ratio,
        "spin_ratio": case.spin_ratio,
        "steps": len(dq),
        "max_error_m": float(np.linalg.norm(rolled.points - points, axis=1).max()),
        "spin_error_rad": float(np.abs(rolled.spins - spins).max()),
        "ns_per_step": rolled.step_ns,
        "reference_ns": unit,
    }


def run_block(some: Sequence[RollingCase]) -> list[dict[str, Any]]:
    return [run_case(case) for case in some]


class DriftCase(NamedTuple):
    """Long roll of one method on one surface."""

    surface: str
    method: str
    steps: int


def run_drift(case: DriftCase) -> dict[str, Any]:
    """Return the largest distance of the contact point from the surface over a long roll, every DRIFT_BLOCK steps.

    The finger rolls in loops of the radius DRIFT_STEP_RAD r DRIFT_BLOCK / 2 pi and spins back and forth. On a plane the
    path remains near the start; on curved shapes it covers the surface.
    """
    shape, center, normal = make_contact(case.surface, None)
    t = 2.0 * np.pi * (np.arange(DRIFT_BLOCK) + 0.5) / DRIFT_BLOCK
    half = 0.5 * DRIFT_STEP_RAD * np.column_stack([np.cos(t), np.sin(t), 0.5 * np.cos(2.0 * t)])
    dq = np.column_stack([np.sqrt(1.0 - np.sum(half * half, axis=1)), half])
    method, drift, blocks = METHODS[case.method], 0.0, case.steps // DRIFT_BLOCK
    for _ in range(blocks):
        out = roll_path_timed(method, shape, center, normal, dq)
        point, n = out.points[-1].tolist(), out.normals[-1].tolist()
        drift = max(drift, abs(float(closest(shape, tuple(point))[0])))
        normal = (n[0], n[1], n[2])
        center = (point[0] + RADIUS_M * n[0], point[1] + RADIUS_M * n[1], point[2] + RADIUS_M * n[2])
    return {"surface": case.surface, "method": case.method, "steps": blocks * DRIFT_BLOCK, "drift_m": drift}


def run_drift_block(some: Sequence[DriftCase]) -> list[dict[str, Any]]:
    return [run_drift(case) for case in some]
