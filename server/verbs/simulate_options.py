"""Options of `softfinger simulate`; `server/verbs/simulate.py` imports the compiler, slower than a help text."""

from __future__ import annotations

import argparse
from pathlib import Path

from softfinger.server.arguments import duration
from softfinger.server.offline.figures import plot_file


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    poses_or_device = parser.add_mutually_exclusive_group(required=True)
    poses_or_device.add_argument(
        "--poses",
        action="append",
        metavar="P",
        help="CSV, npz or MCAP file, or a shipped recording; of several fingers an MCAP of all, or NAME=P for each",
    )
    poses_or_device.add_argument(
        "--device", metavar="D", help="devices that are computed: simulated; they feel the force"
    )
    parser.add_argument("--out", required=True, type=Path, help="where to: .csv, .npz or .mcap")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE.png", help="draw depth, force, angles and modes (.png, .svg)"
    )
    parser.add_argument("--duration", type=duration, metavar="S", help="with --device: how long (10)")
    parser.add_argument("--method", help="rolling method in place of the scene's")
    parser.add_argument("--rate", type=float, metavar="HZ", help="tick rate in place of the rig's (1000)")
    parser.add_argument(
        "--rig",
        help="rig with the guard and the options of the device (replay; with --device "
        "simulated-SCENE, or simulated if there is none)",
    )
