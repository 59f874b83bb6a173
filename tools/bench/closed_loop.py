"""`bench closed-loop`: ticks per second of scene, guard and simulated device together, on one processor."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.simulated.plant import (
    DELAY_LINE_SIZE,
    Handle,
    Impedance,
    Intention,
    Plant,
    PlantInputs,
    PlantState,
    make_plant,
    make_rest_state,
)
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import PackedTree, packed, unpack
from softfinger.server.loop.clock import Stopwatch, make_stopwatch, read_clock_ns, read_thread_cpu_ns
from softfinger.server.loop.tick import Memory, Tuning, make_start_memory
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import TickRange, close_loop
from softfinger.server.progress import map_with_progress
from softfinger.tools.bench.step import ROUNDS, find_quietest, measure_reference_ns
from softfinger.tools.measure import draw_bars, show_and_draw

TICKS: Final = 10_000
"""Ticks in a block."""
CLOCK_TICKS: Final = 1_000
"""Ticks between two readings of the clock, about 0.1 ms, and two cycles of the hand's sway.

Another program that takes the processor for a millisecond disturbs only a few of them.
"""
PERIOD_S: Final = 0.001
DEPTH_M: Final = 0.001
"""Depth of the intended lowest point of the fingertip below the surface; the hand presses all the time."""
HAND: Final = Impedance(mass=0.1, damping=8.0, stiffness=1000.0)
BARE_HANDLE: Final = Handle((0.2, 0.2, 0.2), (1.0, 1.0, 1.0), force_max=12.0)
HANDLES: Final = {
    "mass, damping and hand": BARE_HANDLE,
    "and 2 ticks of delay": BARE_HANDLE._replace(delay=2),
    "and encoders of 10 um": BARE_HANDLE._replace(delay=2, resolution=1e-5),
    "and amplifier lag": BARE_HANDLE._replace(delay=2, resolution=1e-5, lag=0.0005),
    "and Coulomb friction": BARE_HANDLE._replace(delay=2, resolution=1e-5, lag=0.0005, friction=(0.1, 0.1, 0.1)),
}
"""Handles that are timed in the hand; each adds an effect to the one before.

All plants have one type, so that they run the same code.
"""


@entry
def time_ticks(
    tuning_packed: PackedTree,
    start: Memory,
    plant: Plant,
    state: PlantState,
    drive: PlantInputs,
    dt: float,
    watch: Stopwatch,
    cpu_ns: NDArray[np.int64],
) -> float:
    """Run CLOCK_TICKS ticks for each element of `watch` (blocks, m), in sequence, and return the largest force.

    `cpu_ns` (blocks,) receives the processor time of the thread in each block.
    """
    tuning, memory, strongest = unpack(tuning_packed.like, tuning_packed.values), start, 0.0
    timespec, short_ns, tick = watch.timespec, watch.ns, 0
    for block in range(short_ns.shape[0]):
        cpu_begun = read_thread_cpu_ns(timespec)
        for part in range(short_ns.shape[1]):
            start_ns = read_clock_ns(timespec)
            end = close_loop(tuning, start, memory, plant, state, drive, TickRange(tick, CLOCK_TICKS, dt), np.inf)
            memory, state = end.memory, end.state
            strongest = max(strongest, end.force)
            tick += CLOCK_TICKS
            short_ns[block, part] = read_clock_ns(timespec) - start_ns
        cpu_ns[block] = read_thread_cpu_ns(timespec) - cpu_begun
    return strongest


def run(args: argparse.Namespace) -> int:
    scene = load_scene(args.scene)
    if len(scene.fingers) > 1:
        raise ConfigError(
            f"--scene {args.scene}: the simulation moves one finger, but this scene has several: choose another scene"
        )
    tuning = make_tuning(scene, load_rig("replay").guard)
    radius, blocks_of_turn = scene.fingers[0].radius_m, max(args.blocks // ROUNDS, 1)
    turns = map_with_progress(
        "measuring the closed loop",
        lambda _: [measure(tuning, radius, handle, blocks_of_turn) for handle in HANDLES.values()],
        range(ROUNDS),
    )
    rows = [{"plant": name} | summarize(of) for name, *of in zip(HANDLES, *turns, strict=True)]
    result = {"scene": args.scene, "ticks": TICKS * args.blocks, "plants": rows}
    lines = [f"closed loop on {args.scene}: contact step, guard and simulated device, in contact, one processor"]
    lines += [
        f"  {row['plant']:<26}{row['ns_per_tick']:8.1f} ns {row['ratio']:7.3f} of {row['reference_ns']:.0f} ns, "
        f"thread {row['cpu_ns_per_tick']:.1f} ns {row['ticks_per_s'] / 1e6:8.2f} million ticks/s"
        for row in rows
    ]
    costs, unit = {row["plant"]: row["ns_per_tick"] for row in rows}, f"ns per tick on {args.scene}"
    return show_and_draw(args, result, lines, lambda path: draw_bars(path, costs, unit))


def summarize(turns: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the quietest turn of a plant."""
    row: dict[str, Any] = {key: find_quietest([turn[key] for turn in turns]) for key in turns[0]}
    row["p99_block_ns_per_tick"] = float(np.median([turn["p99_block_ns_per_tick"] for turn in turns]))
    row["ticks_per_s"], row["ratio"] = 1e9 / row["ns_per_tick"], row["ns_per_tick"] / row["reference_ns"]
    return row


def measure(tuning: Tuning, radius: float, handle: Handle, blocks: int) -> dict[str, Any]:
    """Return the median cost of a tick with this handle and the cost of the reference, for one turn."""
    goal = radius - DEPTH_M
    plant = make_plant(PERIOD_S, handle, HAND)
    state, poses = make_rest_state((0.0, 0.0, goal)), np.array([0.0, 0.0, goal, 1.0, 0.0, 0.0, 0.0])
    sway = Intention(1.0, 1.0, (0.0005, 0.0, 0.0002), 0.0023, 0.0)  # 2.3 Hz back and forth, so that friction acts
    watch, cpu = make_stopwatch(blocks, TICKS // CLOCK_TICKS), np.zeros(blocks, np.int64)
    drive = PlantInputs(sway, poses, np.zeros(DELAY_LINE_SIZE))
    arguments = (packed(tuning), make_start_memory(tuning.scene), plant, state, drive, PERIOD_S)
    time_ticks(*arguments, make_stopwatch(1, TICKS // CLOCK_TICKS), cpu[:1].copy())
    unit = measure_reference_ns()
    force = time_ticks(*arguments, watch, cpu)
    cost = float(np.median(watch.ns)) / CLOCK_TICKS
    return {
        "ns_per_tick": cost,
        "p99_block_ns_per_tick": float(np.percentile(watch.ns, 99)) / CLOCK_TICKS,
        "cpu_ns_per_tick": float(np.median(cpu)) / TICKS,
        "reference_ns": unit,
        "largest_force_n": float(force),
    }
