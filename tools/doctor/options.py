"""Options of `softfinger doctor`."""

from __future__ import annotations

import argparse

from softfinger.server.arguments import add_flag, add_option
from softfinger.tools.options import add_output_options


def configure_doctor(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check whether this machine can run the daemon: hardware, permissions, timing of the servo loop. Exit code 0 "
        "if no problem is found. With --device-report, write a report on the device of a rig for a bug report."
    )
    add_option(parser, "--rig", "rig file or the name of a shipped one", default="replay")
    add_option(parser, "--scene", "scene whose step is timed", default="paper-plane")
    add_option(parser, "--seconds", "duration of each measurement", default=3.0)
    add_output_options(parser)
    parser.add_argument(
        "--device-report",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device and write a JSON report (default: softfinger-DRIVER-report.json). Only zero "
        "force is sent. Prompts in the terminal request movements of the handle",
    )
    parser.add_argument(
        "--with-force",
        type=float,
        metavar="N",
        help="also apply a force: a slow sine of at most N newtons along x, y and z in turn, within the limits of "
        "rig and device. THE HANDLE MOVES: hold it lightly, and start with 1",
    )
    add_flag(parser, "--no-prompts", "do not prompt, even in a terminal")
