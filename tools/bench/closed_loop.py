"""`bench closed-loop`: ticks per second of scene, guard and simulated device together, on one processor."""

from __future__ import annotations

import argparse
from typing import Any, Final

import numpy as np

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.plant import LINE_SIZE, Intention, Plant, PlantState, at_rest, make_plant
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.pack import flatten, unpack
from softfinger.server.clock import now_ns
from softfinger.server.closed_loop import Array, close_loop
from softfinger.server.figures import figure, save
from softfinger.server.progress import progress
from softfinger.server.tick import Memory, Tuning, begin
from softfinger.server.tuning import make_tuning
from softfinger.tools.bench.step import reference_ns
from softfinger.tools.measure import add_output_options, show

TICKS: Final = 10_000
"""Ticks between two looks at the clock: a case of a study has some 1000."""
PERIOD_S: Final = 0.001
DEPTH_M: Final = 0.001
"""How far below the surface the hand intends the fingertip's lowest point: it presses all the time."""
HAND: Final = {"hand_mass": 0.1, "hand_damping": 8.0, "hand_stiffness": 1000.0}
PARTS: Final[dict[str, dict[str, Any]]] = {
    "mass, damping and hand": {},
    "and 2 ticks of delay": {"delay": 2},
    "and encoders of 10 um": {"delay": 2, "resolution": 1e-5},
    "and amplifier lag": {"delay": 2, "resolution": 1e-5, "lag": 0.0005},
    "and Coulomb friction": {"delay": 2, "resolution": 1e-5, "lag": 0.0005, "friction": (0.1, 0.1, 0.1)},
}
"""Plants that are timed, each with what the one before it has; of one type, so they run the same code."""


@entry
def time_ticks(
    tuning_like: Tuning,
    values: Array,
    start: Memory,
    plant: Plant,
    state: PlantState,
    intention: Intention,
    poses: Array,
    line: Array,
    dt: float,
    timespec: Any,
    block_ns: Any,
) -> float:
    """A block of TICKS ticks for each of `block_ns`, one after the other; returns the largest force."""
    tuning, memory, strongest = unpack(tuning_like, values), start, 0.0
    for block in range(block_ns.shape[0]):
        begun = now_ns(timespec)
        end = close_loop(tuning, start, memory, plant, state, intention, poses, line, block * TICKS, TICKS, dt, np.inf)
        memory, state = end.memory, end.state
        strongest = max(strongest, end.force)
        block_ns[block] = now_ns(timespec) - begun
    return strongest


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scene", default="frictionless-plane", help="scene with its first surface at z = 0 (%(default)s)"
    )
    parser.add_argument("--blocks", type=int, default=100, help=f"blocks of {TICKS} ticks (default: %(default)s)")
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    scene, blocks = load_scene(args.scene), max(args.blocks, 1)
    tuning = make_tuning(scene, load_rig("replay").guard)
    rows = []
    with progress("measuring the closed loop", len(PARTS)) as done:
        for number, (name, parts) in enumerate(PARTS.items()):
            rows.append(measure(tuning, scene.fingertip.radius_m, name, parts, blocks))
            done(number + 1)
    result = {"scene": args.scene, "ticks": TICKS * blocks, "plants": rows}
    lines = [f"closed loop on {args.scene}: contact step, guard and simulated device, in contact, one processor"]
    lines += [
        f"  {row['plant']:<26}{row['ns_per_tick']:8.1f} ns {row['ratio']:7.3f} of {row['reference_ns']:.0f} ns "
        f"{row['ticks_per_s'] / 1e6:8.2f} million ticks/s"
        for row in rows
    ]
    show(result, args.json, lines)
    if args.plot:
        drawing = figure(height=3.0)
        axes = drawing.add_subplot()
        axes.barh([row["plant"] for row in rows][::-1], [row["ns_per_tick"] for row in rows][::-1])
        axes.set_xlabel(f"ns per tick on {args.scene}")
        save(drawing, args.plot)
    return 0


def measure(tuning: Tuning, radius: float, name: str, parts: dict[str, Any], blocks: int) -> dict[str, Any]:
    """Median cost of a tick with a plant of these parts, and that of the reference beside it."""
    goal = radius - DEPTH_M
    plant = make_plant(PERIOD_S, (0.2, 0.2, 0.2), (1.0, 1.0, 1.0), force_max=12.0, **(HAND | parts))
    state, poses = at_rest((0.0, 0.0, goal)), np.array([0.0, 0.0, goal, 1.0, 0.0, 0.0, 0.0])
    sway = Intention(1.0, 1.0, (0.0005, 0.0, 0.0002), 0.0023, 0.0)  # 2.3 Hz to and fro: friction has work to do
    times, timespec = np.zeros(blocks, np.int64), np.zeros(2, np.int64)
    arguments = (tuning, flatten(tuning), begin(tuning.scene), plant, state, sway, poses, np.zeros(LINE_SIZE))
    time_ticks(*arguments, PERIOD_S, timespec, times[:1].copy())
    unit = reference_ns()
    force = time_ticks(*arguments, PERIOD_S, timespec, times)
    cost = float(np.median(times)) / TICKS
    return {
        "plant": name,
        "ns_per_tick": cost,
        "p99_block_ns_per_tick": float(np.percentile(times, 99)) / TICKS,
        "ticks_per_s": 1e9 / cost,
        "reference_ns": unit,
        "ratio": cost / unit,
        "largest_force_n": float(force),
    }
