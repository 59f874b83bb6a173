"""Options of the verbs in this folder, and those that several measurements have.

The modules of the verbs import the code that they measure, which would delay a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from softfinger.server.arguments import add_flag, add_option
from softfinger.server.offline.figures import plot_file

PUSH_N: Final = 0.2
"""Amplitude of the pushes: a tenth of the force of most devices, and more than the friction of a good one."""


def add_output_options(parser: argparse.ArgumentParser) -> None:
    add_flag(parser, "--json", "print the result as JSON")
    parser.add_argument("--plot", type=plot_file, metavar="FILE.png", help="plot the result (.png, .svg; extra plots)")


def add_sweep_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("computation and storage")
    group.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a dask scheduler, or 'local' for local processes"
    )
    group.add_argument(
        "--results", type=Path, metavar="FILE.mcap", help="file for finished cases; a second run continues there"
    )


def configure_devices(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List attached devices with their driver. For a device that cannot be opened, show the reason and the command "
        "that fixes it. Devices are opened only with --ask or --probe."
    )
    add_flag(parser, "--json", "print the result as JSON")
    add_flag(parser, "--ask", "open each free device and read its data")
    parser.add_argument(
        "--rig",
        help="rig that names the library or firmware file of its driver; with --ask, the vendor's library or service "
        "is queried even if no device is listed on USB",
    )
    parser.add_argument(
        "--probe",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device (default: the first attached one) for ten seconds at zero force; show rate, range, "
        "noise, buttons and axes, and write a report (default: softfinger-DRIVER-report.json)",
    )
    add_flag(
        parser,
        "--push",
        f"with --probe: then apply {PUSH_N:g} N in both directions of each axis and ask for the felt direction. "
        "THE HANDLE MOVES: hold it lightly",
    )


def configure_report(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write an archive for a bug report: versions, output of doctor, rig, scene, and the latest black box files "
        "with their log. Names of the user and the machine, folders and serial numbers are removed. Check the "
        "archive before you send it."
    )
    add_option(parser, "--rig", "rig file or name", default="replay")
    add_option(parser, "--scene", "scene file or name", default="paper-plane")
    add_option(parser, "--out", "archive", default=Path("softfinger-report.tar.gz"), type=Path, metavar="FILE")
    add_option(parser, "--boxes", "number of black boxes, latest first", default=3, metavar="N")
    add_option(parser, "--seconds", "duration of each measurement of doctor", default=1.0)


def configure_calibrate(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--rig", "rig file of a Falcon, or the name of a shipped one", default="falcon", metavar="FILE")
    parser.add_argument("--mass", type=float, required=True, metavar="KG", help="mass of the weight, 0.02 to 0.4")
    add_option(parser, "--hang", "time to attach the weight", default=60.0, metavar="S")
    add_output_options(parser)
