"""Test with random garbage as samples of a device: every tick must give a finite force within the guard's limits."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan
from typing import Any, Final

import numpy as np

from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.guard import POSE_REFUSED
from softfinger.server.loop.tick import begin
from softfinger.server.offline.simulate import run_ticks
from softfinger.server.progress import show_progress
from softfinger.tools.measure import Array
from softfinger.tools.stability.extremes import BALL, BLOCK, WALLS, R, count_violations, make_case_tuning, make_scene

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
            scene_and_guard, memory = packed(tuning), packed(begin(tuning.scene))
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
    lines = ["| scene | ticks | rules broken | poses refused | largest force |", "|---|---|---|---|---|"]
    lines += [
        f"| {row['scene']} | {row['ticks']} | {row['broken']} | {row['refused']} | {row['force_max_n']:.6g} N |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"
