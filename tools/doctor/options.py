"""Options of `softfinger doctor`."""

from __future__ import annotations

import argparse

from softfinger.tools.options import add_option, add_output_options


def configure_doctor(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check whether this machine can run the daemon: hardware, permissions, timing of the servo loop. Exit code 0 "
        "if no problem is found. With --device-report, write a report on the device of a rig for a bug report."
    )
    add_option(parser, "--rig", "replay", "rig file or the name of a shipped one")
    add_option(parser, "--scene", "paper-plane", "scene whose step is timed")
    add_option(parser, "--seconds", 3.0, "duration of each measurement")
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
    parser.add_argument("--no-prompts", action="store_true", help="do not prompt, even in a terminal")
