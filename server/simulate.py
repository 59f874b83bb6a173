"""`simulate`: the servo's tick offline, as fast as it goes, over poses or with a device that is computed."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_rig, load_scene
from softfinger.drivers import registry
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.engine import check_poses
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.pack import flatten, pack, unpack
from softfinger.proxy.state import CAUSE_NAMES, MODE_NAMES, OFFSET, RECORD_SIZE
from softfinger.server.clock import NS_PER_S, period_ns
from softfinger.server.figures import plot_file
from softfinger.server.progress import CHUNK, progress
from softfinger.server.results import write_results
from softfinger.server.run import duration
from softfinger.server.run_figure import draw_run
from softfinger.server.tick import Memory, Tuning, begin, tick
from softfinger.server.tuning import make_tuning

Array = NDArray[np.float64]

DURATION_S = 10.0
"""How long a device is run that nobody gave a time."""


@entry
def tick_many(
    tuning_like: Tuning,
    values: Array,
    start: Memory,
    memory_values: Array,
    poses: Array,
    dts: Array,
    first: int,
    records: Array,
) -> None:
    """One tick for each row of `poses` (n, 7), `dts` (n,) s after the one before, with a record each in `records`."""
    tuning = unpack(tuning_like, values)
    memory = unpack(start, memory_values)
    for i in range(poses.shape[0]):
        memory = tick(tuning, start, memory, poses[i], dts[i], first + i, records[i])
    pack(memory_values, memory)


def simulate(tuning: Tuning, poses: Array, rate_hz: float) -> Array:
    """Records (n, RECORD_SIZE) of the poses (n, 7), one tick each, as the daemon computes them.

    The timestamp is the tick times dt, and the fields of servo timing and device are 0.
    """
    dt = period_ns(rate_hz) / NS_PER_S
    checked = check_poses(poses)
    records, dts = np.zeros((len(checked), RECORD_SIZE)), np.full(min(len(checked), CHUNK), dt)
    records[:, OFFSET["timestamp"]] = np.arange(len(checked)) * dt
    start = begin(tuning.scene)
    values, memory = flatten(tuning), flatten(start)
    with progress("simulating", len(checked)) as done:
        for first in range(0, len(checked), CHUNK):
            chunk = slice(first, first + CHUNK)
            tick_many(tuning, values, start, memory, checked[chunk], dts, first, records[chunk])
            done(min(first + CHUNK, len(checked)))
    return records


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", required=True, help="scene file or the name of a shipped one")
    felt = parser.add_mutually_exclusive_group(required=True)
    felt.add_argument("--poses", help="CSV, npz or MCAP file, or the name of a shipped recording")
    felt.add_argument("--device", metavar="D", help="a device that is computed: simulated; it feels the force")
    parser.add_argument("--out", required=True, type=Path, help="where to: .csv, .npz or .mcap")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE.png", help="draw depth, force, angles and modes (.png, .svg)"
    )
    parser.add_argument("--duration", type=duration, metavar="S", help="with --device: how long (10)")
    parser.add_argument("--method", help="rolling method in place of the scene's")
    parser.add_argument("--rate", type=float, metavar="HZ", help="tick rate in place of the rig's (1000)")
    parser.add_argument(
        "--rig", help="rig whose guard limits the force, and whose options the device has (replay, simulated)"
    )


def run(args: argparse.Namespace) -> int:
    scene_changes = {} if args.method is None else {"rolling.method": args.method}
    rig_changes = {} if args.rate is None else {"servo.rate_hz": args.rate}
    rig_name = args.rig or ("replay" if args.device is None else "simulated")
    if args.device is not None:
        rig_changes["device.driver"] = args.device
    elif args.duration is not None:
        raise ConfigError("--duration goes with --device: poses last as long as they do")
    scene = load_scene(args.scene, scene_changes, {"rolling.method": "command line --method"})
    rig = load_rig(
        rig_name, rig_changes, {"servo.rate_hz": "command line --rate", "device.driver": "command line --device"}
    )
    rate = rig.servo.rate_hz
    if args.device is None:
        poses = resample(load_poses(args.poses), rate)
        records = simulate(make_tuning(scene, rig.guard), poses, rate)
    else:
        records = with_device(scene, rig, DURATION_S if args.duration is None else args.duration)
    write_results(args.out, records)
    if args.plot is not None:
        draw_run(records, args.plot)
    print(f"{args.out}: {len(records)} ticks at {rate:g} Hz; {summary(records)}")
    return 0


def with_device(scene: schema.Scene, rig: schema.Rig, seconds: float) -> Array:
    """Records of a scene felt through the rig's simulated device; ConfigError for a device that is not computed."""
    # Compiled when imported, which a run over poses need not wait for.
    from softfinger.server.closed_loop import run_closed_loop

    rate, driver = rig.servo.rate_hz, registry.load(rig.device.driver)
    if not hasattr(driver, "simulation"):
        raise ConfigError(
            f"device '{rig.device.driver}' cannot be run without a clock: take the device `simulated`, or --poses"
        )
    options = build(driver.Options, rig.device.options, "[device]")
    if getattr(options, "puck", None) is not None:
        raise ConfigError("a hand that a puck leads cannot be run without a clock: use `run`, or leave puck out")
    # The records hold the forces; a file of what a servo wrote would be empty.
    with driver.open_device(msgspec.structs.replace(options, forces=None), rate) as device:
        ticks = max(1, round(seconds * rate))
        intention = device.simulation.intention
        if not intention.loop:
            ticks = min(ticks, int(intention.length))
        tuning = make_tuning(scene, rig.guard, device.info)
        return run_closed_loop(tuning, device.simulation, rate, ticks)


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
