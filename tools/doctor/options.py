"""Options of `softfinger doctor`."""

from __future__ import annotations

import argparse

from softfinger.tools.options import add_output_options


def configure_doctor(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check whether this machine is good enough: hardware, permissions, timing of the servo loop. Exit code 0 if "
        "nothing is bad. With --device-report: a file on the device of a rig, to be attached to an issue."
    )
    parser.add_argument("--rig", default="replay", help="rig file or the name of a shipped one (default: %(default)s)")
    parser.add_argument("--scene", default="paper-plane", help="scene whose step is timed (default: %(default)s)")
    parser.add_argument(
        "--seconds", type=float, default=3.0, help="of each loop, or of each part of a report (default: %(default)s)"
    )
    add_output_options(parser)
    parser.add_argument(
        "--device-report",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device and write a report on it to a JSON file (softfinger-DRIVER-report.json). "
        "Only zero force is sent. In a terminal, prompts ask for movements of the handle",
    )
    parser.add_argument(
        "--with-force",
        type=float,
        metavar="N",
        help="also push: a slow sine of at most N newtons along x, y, z in turn, faded in and out, never above what "
        "rig and device allow. THE HANDLE MOVES: hold it lightly, and take 1 first",
    )
    parser.add_argument("--no-prompts", action="store_true", help="ask for nothing, also on a terminal")
