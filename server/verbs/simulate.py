"""`simulate`: the servo's tick offline, as fast as it goes, over poses or with a device that is computed."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.record import CAUSE_NAMES, MODE_NAMES
from softfinger.proxy.records import Records
from softfinger.server.arguments import by_finger, duration
from softfinger.server.offline.figures import plot_file
from softfinger.server.offline.results import write_results
from softfinger.server.offline.run_figure import draw_run
from softfinger.server.offline.simulate import over_recordings, with_device

DURATION_S = 10.0
"""How long a device is run that nobody gave a time."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", required=True, help="scene file or the name of a shipped one")
    felt = parser.add_mutually_exclusive_group(required=True)
    felt.add_argument(
        "--poses",
        action="append",
        metavar="P",
        help="CSV, npz or MCAP file, or a shipped recording; of several fingers an MCAP of all, or NAME=P for each",
    )
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
    fingers = [finger.name for finger in scene.fingers]
    if args.device is None:
        records = over_recordings(scene, rig, by_finger(args.poses, "--poses"))
    elif len(fingers) > 1:
        raise ConfigError("--device: several fingers are simulated on recordings: give --poses NAME=P for each")
    else:
        records = {fingers[0]: Records(with_device(scene, rig, DURATION_S if args.duration is None else args.duration))}
    single = len(fingers) == 1
    write_results(args.out, records[fingers[0]] if single else records)
    for name, each in records.items():
        if args.plot is not None:
            draw_run(each, args.plot if single else args.plot.with_stem(f"{args.plot.stem}-{name}"))
        told = f"{args.out}" if single else f"{args.out}, {name}"
        print(f"{told}: {len(each)} ticks at {rig.servo.rate_hz:g} Hz; {summary(each)}")
    return 0


def summary(records: Records) -> str:
    """Modes, mode changes and largest force of a run, in a line."""
    mode, cause = records["contact.mode"], records["contact.cause"]
    modes = ", ".join(f"{name} {np.mean(mode == number):.1%}" for number, name in enumerate(MODE_NAMES))
    changes = ", ".join(
        f"{count} {name}"
        for number, name in enumerate(CAUSE_NAMES)
        if number and (count := np.count_nonzero(cause == number))
    )
    peak = np.linalg.norm(records["force"], axis=1).max(initial=0.0)
    return f"{modes}; {changes or 'no contact'}; largest force {peak:.3f} N"
