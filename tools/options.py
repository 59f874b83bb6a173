"""Options of the verbs in this folder, and those that several measurements have.

The modules of the verbs import what they measure, which takes longer than a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from softfinger.server.offline.figures import plot_file

PUSH_N: Final = 0.2
"""A tenth of the force of most devices, and more than the friction of a good one."""
BOXES: Final = 3
REPORT: Final = "softfinger-report.tar.gz"


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add `--json` and `--plot`, which every measurement has."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE.png", help="draw the result, as .png or .svg (needs the [plots] extra)"
    )


def add_sweep_options(parser: argparse.ArgumentParser) -> None:
    """Add `--scheduler` and `--results`, which every command of many cases has."""
    group = parser.add_argument_group("computation and storage")
    group.add_argument("--scheduler", metavar="ADDRESS", help="dask scheduler, or 'local' for processes here")
    group.add_argument(
        "--results", type=Path, metavar="FILE.mcap", help="stores finished cases; a second run continues"
    )


def configure_devices(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List attached devices, the driver of each, why one cannot be opened, and the command that corrects it. "
        "Nothing is opened, so a device in use is not disturbed, unless --ask is given."
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--ask", action="store_true", help="open each free device, and read its data")
    parser.add_argument(
        "--rig",
        help="rig with the library or firmware file for the devices of its driver; with --ask its maker's library "
        "or service is queried also if USB lists none of them",
    )
    parser.add_argument(
        "--probe",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device (default: the first that is attached) for ten seconds with zero force; show rate, "
        "range, noise, buttons and axes, and write a device report (softfinger-DRIVER-report.json)",
    )
    parser.add_argument(
        "--push",
        action="store_true",
        help=f"with --probe: then push with {PUSH_N:g} N along each axis and back, and ask what was felt. THE HANDLE "
        "MOVES: hold it lightly",
    )


def configure_report(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write an archive for an issue: versions, doctor, rig and scene, and the newest files of the black box with "
        "their log. Names of the user and the machine, folders and serial numbers are taken out. Look at it before you "
        "send it."
    )
    parser.add_argument("--rig", default="replay", help="rig file or name (default: %(default)s)")
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path(REPORT), metavar="FILE", help="archive (default: %(default)s)")
    parser.add_argument(
        "--boxes",
        type=int,
        default=BOXES,
        metavar="N",
        help="number of black boxes, latest first (default: %(default)s)",
    )
    parser.add_argument("--seconds", type=float, default=1.0, help="of each loop of doctor (default: %(default)s)")


def configure_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rig", default="falcon", metavar="FILE", help="rig of a Falcon, or the name of a shipped one")
    parser.add_argument("--mass", type=float, required=True, metavar="KG", help="of the weight, 0.02 to 0.4")
    parser.add_argument("--hang", type=float, default=60.0, metavar="S", help="time to hang the weight (60)")
    add_output_options(parser)
