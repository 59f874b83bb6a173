"""Random closed-loop runs, many in parallel: their speed, and a test that no knock grows on a passive wall.

A device is drawn for every hundred runs, and a wall for each run. A run is short, so it only shows whether the swing
after a knock has grown out of reach. Growth on a passive wall would be a defect of this program.

`try_hostile` gives random garbage as samples of a device: every tick must give a finite force within the guard's
limits.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from math import inf, nan
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from softfinger.proxy.kernels.jit.pack import flatten, packed
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.guard import POSE_REFUSED
from softfinger.server.loop.tick import make_start_memory
from softfinger.server.offline.simulate import run_ticks
from softfinger.server.progress import show_progress
from softfinger.server.verbs.schema import format_grid
from softfinger.tools.measure import Array
from softfinger.tools.stability.extremes import BALL, BLOCK, WALLS, R, count_violations, make_case_tuning, make_scene
from softfinger.tools.stability.limit import TrialParameters, WallCase, compile_search, loop_of, run_rows
from softfinger.tools.stability.predicted import compute_passive_limit
from softfinger.tools.sweep import run_cases

RUNS_PER_DEVICE: Final = 100
"""Computing the exact matrices of a device costs as much as about three runs of 1000 ticks."""
RUNS_PER_BLOCK: Final = 1000
STUDY_SIZE: Final = (1_000_000, 1000)
"""Runs and ticks of the study for which the time is reported."""


class RunBlock(msgspec.Struct, frozen=True):
    """Block of the runs: its number, runs, ticks per run, and the common seed."""

    number: int
    runs: int
    ticks: int
    seed: int


def make_random_device(random: np.random.Generator) -> WallCase:
    """Return a desktop device at a random rate, with up to two ticks of delay."""
    mass, damping, rate = np.exp(random.uniform(np.log([0.05, 0.1, 500.0]), np.log([1.0, 10.0, 8000.0]))).tolist()
    return WallCase(mass_kg=mass, damping_ns_per_m=damping, rate_hz=rate, delay_ticks=int(random.integers(3)))


def run_blocks(blocks: Sequence[RunBlock]) -> list[dict[str, int]]:
    """Return for each block: runs, ticks, swings that grew out of reach, passive walls, and such swings on these."""
    return [_run_block(block) for block in blocks]


def _run_block(block: RunBlock) -> dict[str, int]:
    random = np.random.default_rng([block.seed, block.number])
    loops, plants, passive = [], [], []
    for first in range(0, block.runs, RUNS_PER_DEVICE):
        runs = min(RUNS_PER_DEVICE, block.runs - first)
        device = make_random_device(random)
        plant, bare = device.plant(), compute_passive_limit(device.linear())
        # Walls from a tenth to ten times the passive limit of the device, damped by up to twice its damping.
        stiffness = bare * 10.0 ** random.uniform(-1.0, 1.0, runs)
        share = np.maximum(0.0, random.uniform(-1.0, 2.0, runs))
        rows = np.tile(loop_of(device, 0.0, block.ticks), (runs, 1))
        rows[:, TrialParameters._fields.index("first")] = stiffness
        rows[:, TrialParameters._fields.index("damping")] = share * device.damping_ns_per_m
        loops.append(rows)
        plants.append(np.tile(flatten(plant), (runs, 1)))
        passive.append(stiffness <= (1.0 - share) * bare)  # B reduces the bound as it reduces b
    out = run_rows(np.concatenate(loops), np.concatenate(plants), plant)
    has_left = out[:, 2] < block.ticks
    inside = np.concatenate(passive)
    return {
        "runs": block.runs,
        "ticks": int(out[:, 2].sum()),
        "left": int(has_left.sum()),
        "passive": int(inside.sum()),
        "passive_left": int((has_left & inside).sum()),
    }


def measure(runs: int, ticks: int, seed: int, scheduler: str | None, results: Path | None) -> dict[str, Any]:
    """Compute random runs; return the sums of all blocks, their time and rate, and the estimated time of STUDY_SIZE.

    The rate is None if a file already had results, since their time is unknown.
    """
    fresh = results is None or not results.exists()
    blocks = [
        RunBlock(number, min(RUNS_PER_BLOCK, runs - first), ticks, seed)
        for number, first in enumerate(range(0, runs, RUNS_PER_BLOCK))
    ]
    compile_search()
    start = time.perf_counter()
    rows = run_cases(run_blocks, blocks, label="random runs", scheduler=scheduler, results=results, block=1)
    seconds = time.perf_counter() - start
    sums = {name: sum(part[name] for part in rows) for name in rows[0]}
    rate = sums["ticks"] / seconds if fresh else None
    needed = STUDY_SIZE[0] * STUDY_SIZE[1] / rate if rate else None
    return {**sums, "seconds": seconds, "ticks_per_s": rate, "million_runs_s": needed}


def format_table(result: dict[str, Any]) -> list[str]:
    lines = [
        f"{result['runs']} random closed-loop runs, {result['ticks']} ticks in {result['seconds']:.1f} s",
        f"  {result['left']} swings grew out of reach; of {result['passive']} passive walls {result['passive_left']}",
    ]
    if result["ticks_per_s"] is not None:
        lines.append(
            f"  {result['ticks_per_s'] / 1e6:.2f} million ticks a second: a million runs of 1000 ticks take "
            f"{result['million_runs_s']:.0f} s"
        )
    return lines


HOSTILE_SCENES: Final = {
    "plane": make_scene(),
    "sphere": make_scene(BALL),
    "box": make_scene(BLOCK),
    "three walls": make_scene(*WALLS),
}
HOSTILE_BLOCK: Final = 20_000
WILD_VALUES: Final = np.array([nan, inf, -inf, 0.0, -0.0, 5e-324, -5e-324, 1.7e308, -1.7e308])
"""Values that no device should send; numbers of any size are used, too."""


def make_garbage(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Return samples (count, 7) and time steps (count,) s; a quarter of the samples has invalid values."""
    samples = rng.uniform(-1.0, 1.0, (count, 7))
    samples[:, :3] *= 2.0 * R
    is_invalid = (rng.random((count, 1)) < 0.25) & (rng.random((count, 7)) < 0.125)
    special = rng.choice(WILD_VALUES, (count, 7))
    sized = rng.choice([-1.0, 1.0], (count, 7)) * 10.0 ** rng.uniform(-300.0, 300.0, (count, 7))
    samples[is_invalid] = np.where(rng.random((count, 7)) < 0.5, special, sized)[is_invalid]
    dts = np.full(count, 0.001)
    odd = rng.integers(0, 16, count)
    dts[odd == 0] = 0.0
    dts[odd == 1] = 10.0 ** rng.uniform(-9.0, 3.0, np.count_nonzero(odd == 1))
    return samples, dts


def try_hostile(ticks: int, seed: int = 1) -> list[dict[str, Any]]:
    """Run `ticks` random ticks on each of HOSTILE_SCENES; returns violations, refusals and the largest force."""
    rows = []
    with show_progress("hostile input", ticks * len(HOSTILE_SCENES)) as update:
        for number, (name, mapping) in enumerate(HOSTILE_SCENES.items()):
            tuning, rng = make_case_tuning(mapping), np.random.default_rng((seed, number))
            scene_and_guard, memory = packed(tuning), packed(make_start_memory(tuning.scene))
            records = np.zeros((HOSTILE_BLOCK, RECORD_SIZE))
            broken, refused, strongest = 0, 0, 0.0
            for first in range(0, ticks, HOSTILE_BLOCK):
                samples, dts = make_garbage(rng, min(HOSTILE_BLOCK, ticks - first))
                part = records[: len(samples)]
                run_ticks(scene_and_guard, memory, samples[:, None], dts, 0.001, first, part[:, None])
                broken += count_violations(part, 0.001)
                refused += int(np.count_nonzero(part[:, AT.servo_guard] == POSE_REFUSED))
                strongest = max(strongest, float(np.linalg.norm(part[:, AT.force : AT.force + 3], axis=1).max()))
                update(number * ticks + first + len(samples))
            rows.append({"scene": name, "ticks": ticks, "broken": broken, "refused": refused, "force_max_n": strongest})
    return rows


def format_hostile_table(rows: Sequence[dict[str, Any]]) -> str:
    head = ["scene", "ticks", "rules broken", "poses refused", "largest force"]
    keys = ("scene", "ticks", "broken", "refused")
    lines = [[*(f"{row[key]}" for key in keys), f"{row['force_max_n']:.6g} N"] for row in rows]
    return format_grid(head, lines) + "\n"
