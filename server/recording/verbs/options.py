"""Options of the verbs in this folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from softfinger.server.offline.figures import plot_file

TOLERANCE: Final = 1e-9
"""N, N m, m: possible difference between processors after many ticks; results on one machine are identical."""


def _add_recording(parser: argparse.ArgumentParser) -> None:
    kinds = "MCAP file, results or poses (.csv, .npz), or the name of a shipped recording"
    parser.add_argument("recording", metavar="RECORDING", help=kinds)


def configure_info(parser: argparse.ArgumentParser) -> None:
    _add_recording(parser)
    parser.add_argument("--json", action="store_true", help="print as JSON, with rig and scene")


def configure_export(parser: argparse.ArgumentParser) -> None:
    _add_recording(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="output file: .csv, .parquet or .npz")
    parser.add_argument("--finger", default="", metavar="NAME", help="finger to export, if there are several")


def configure_import(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "table", type=Path, metavar="TABLE", help="text file, separated by commas, semicolons, tabs or blanks"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE.csv", help="output file for --recording and --poses"
    )
    parser.add_argument(
        "--columns", required=True, metavar="NAMES",
        help="quantity in each column: t,x,y,z,qw,qx,qy,qz, or - to ignore it; such as t,x,y,z,-,-,-",
    )  # fmt: skip
    parser.add_argument(
        "--unit-s", type=float, default=1.0, metavar="S", help="unit of t in s; 0.001 for ms (default: %(default)s)"
    )
    parser.add_argument(
        "--unit-m",
        type=float,
        default=1.0,
        metavar="M",
        help="unit of x, y, z in m; 0.001 for mm (default: %(default)s)",
    )
    parser.add_argument("--rate", type=float, metavar="HZ", help="rows per second of a table without times")
    parser.add_argument(
        "--skip", type=int, default=0, metavar="N", help="number of lines to skip at the start (default: %(default)s)"
    )


def configure_replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording",
        metavar="RECORDING",
        help="MCAP file; or poses (.csv, .npz, a shipped name) with --scene and --against",
    )
    parser.add_argument(
        "--against", type=Path, metavar="FORCES", help="reference forces: results, or the output of a replay"
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=TOLERANCE,
        metavar="N",
        help="largest allowed difference in N, N m and m (default: %(default)s)",
    )
    parser.add_argument("--scene", help="scene that replaces the recorded one")
    parser.add_argument("--rig", help="rig whose force limits replace the recorded ones")
    parser.add_argument("--rate", type=float, metavar="HZ", help="tick rate for poses (default: 1000)")
    parser.add_argument("--plot", type=plot_file, metavar="FILE.png", help="plot both forces and their difference")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
