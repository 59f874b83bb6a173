"""`simulate`: the servo's tick over recorded poses, offline, to the same bits and as fast as it goes."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.engine import check_poses
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.pack import flatten, pack, unpack
from softfinger.proxy.state import CAUSE_NAMES, MODE_NAMES, OFFSET, RECORD_SIZE
from softfinger.server.clock import NS_PER_S, period_ns
from softfinger.server.progress import progress
from softfinger.server.results import write_results
from softfinger.server.tick import Memory, Tuning, begin, tick
from softfinger.server.tuning import make_tuning

Array = NDArray[np.float64]

CHUNK = 65536
"""Ticks between two reports of progress."""


@entry
def tick_many(
    tuning_like: Tuning,
    values: Array,
    start: Memory,
    memory_values: Array,
    poses: Array,
    dt: float,
    first: int,
    records: Array,
) -> None:
    """One tick for each row of `poses` (n, 7), leaving a record each in `records` (n, RECORD_SIZE)."""
    tuning = unpack(tuning_like, values)
    memory = unpack(start, memory_values)
    for i in range(poses.shape[0]):
        memory = tick(tuning, start, memory, poses[i], dt, first + i, records[i])
        records[i, 0] = (first + i) * dt
    pack(memory_values, memory)


def simulate(tuning: Tuning, poses: Array, rate_hz: float) -> Array:
    """Records (n, RECORD_SIZE) of the poses (n, 7), one tick each, as the daemon computes them.

    The timestamp is the tick times dt, and the fields of servo timing and device are 0.
    """
    dt = period_ns(rate_hz) / NS_PER_S
    checked = check_poses(poses)
    records = np.zeros((len(checked), RECORD_SIZE))
    start = begin(tuning.scene)
    values, memory = flatten(tuning), flatten(start)
    with progress("simulating", len(checked)) as done:
        for first in range(0, len(checked), CHUNK):
            chunk = slice(first, first + CHUNK)
            tick_many(tuning, values, start, memory, checked[chunk], dt, first, records[chunk])
            done(min(first + CHUNK, len(checked)))
    return records


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", required=True, help="scene file or the name of a shipped one")
    parser.add_argument("--poses", required=True, help="CSV, npz or MCAP file, or the name of a shipped recording")
    parser.add_argument("--out", required=True, type=Path, help="where to: .csv, .npz or .mcap")
    parser.add_argument("--method", help="rolling method in place of the scene's")
    parser.add_argument("--rate", type=float, metavar="HZ", help="tick rate in place of the rig's (1000)")
    parser.add_argument("--rig", default="replay", help="rig whose guard limits the force (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    scene_changes = {} if args.method is None else {"rolling.method": args.method}
    rig_changes = {} if args.rate is None else {"servo.rate_hz": args.rate}
    scene = load_scene(args.scene, scene_changes, {"rolling.method": "command line --method"})
    rig = load_rig(args.rig, rig_changes, {"servo.rate_hz": "command line --rate"})
    poses = resample(load_poses(args.poses), rig.servo.rate_hz)
    records = simulate(make_tuning(scene, rig.guard), poses, rig.servo.rate_hz)
    write_results(args.out, records)
    print(f"{args.out}: {len(records)} ticks at {rig.servo.rate_hz:g} Hz; {summary(records)}")
    return 0


def summary(records: Array) -> str:
    """Modes, mode changes and largest force of a run, in a line."""
    mode, cause = records[:, OFFSET["contact.mode"]], records[:, OFFSET["contact.cause"]]
    modes = ", ".join(f"{name} {np.mean(mode == number):.1%}" for number, name in enumerate(MODE_NAMES))
    changes = ", ".join(
        f"{count} {name}"
        for number, name in enumerate(CAUSE_NAMES)
        if number and (count := np.count_nonzero(cause == number))
    )
    at = OFFSET["force"]
    peak = np.linalg.norm(records[:, at : at + 3], axis=1).max(initial=0.0)
    return f"{modes}; {changes or 'no contact'}; largest force {peak:.3f} N"
