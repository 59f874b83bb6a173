"""Options of the verbs in this folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from softfinger.server.offline.figures import plot_file

TOLERANCE: Final = 1e-9
"""N, N m, m: possible difference between processors after many ticks; results on one machine are identical."""


def configure_info(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", metavar="RECORDING", help="an .mcap; results or poses (.csv, .npz); a shipped name"
    )
    parser.add_argument("--json", action="store_true", help="print it as JSON, with rig and scene")


def configure_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", metavar="RECORDING", help="an .mcap; results or poses (.csv, .npz); a shipped name"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".csv, .parquet or .npz")
    parser.add_argument("--finger", default="", metavar="NAME", help="which of several fingers")


def configure_import(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("table", type=Path, metavar="TABLE", help="text; commas, semicolons, tabs or blanks between")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE.csv", help="poses, for --recording and --poses"
    )
    parser.add_argument(
        "--columns", required=True, metavar="NAMES",
        help="content of the columns, such as t,x,y,z,-,-,-: of t,x,y,z,qw,qx,qy,qz, or - to ignore it",
    )  # fmt: skip
    parser.add_argument("--unit-s", type=float, default=1.0, metavar="S", help="unit of t in s (0.001 for ms)")
    parser.add_argument("--unit-m", type=float, default=1.0, metavar="M", help="unit of x, y, z in m (0.001 for mm)")
    parser.add_argument("--rate", type=float, metavar="HZ", help="rows per second of a table without times")
    parser.add_argument("--skip", type=int, default=0, metavar="N", help="lines to leave out at the beginning")


def configure_replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording",
        metavar="RECORDING",
        help="an .mcap; or poses (.csv, .npz, a shipped name), with --scene and --against",
    )
    parser.add_argument(
        "--against", type=Path, metavar="FORCES", help="reference: results, or the forces written by a replay"
    )
    parser.add_argument(
        "--tolerance", type=float, default=TOLERANCE, metavar="N", help="largest difference, N, N m, m (%(default)s)"
    )
    parser.add_argument("--scene", help="scene in place of the recording's")
    parser.add_argument("--rig", help="rig with the guard that limits the force, instead of the recording's")
    parser.add_argument("--rate", type=float, metavar="HZ", help="of poses that are no recording (1000)")
    parser.add_argument("--plot", type=plot_file, metavar="FILE.png", help="draw both forces and their difference")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")
