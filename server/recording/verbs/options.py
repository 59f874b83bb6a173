"""Options of the verbs in this folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from softfinger.server.arguments import Parser, add_flag, add_option
from softfinger.server.offline.figures import plot_file

TOLERANCE: Final = 1e-9
"""N, N m, m: possible difference between processors after many ticks; results on one machine are identical."""


def _add_recording(parser: Parser) -> None:
    kinds = "MCAP file, results or poses (.csv, .npz), or the name of a shipped recording"
    add_option(parser, "recording", kinds, metavar="RECORDING")


def configure_info(parser: Parser) -> None:
    _add_recording(parser)
    add_flag(parser, "--json", "print as JSON, with rig and scene")


def configure_export(parser: Parser) -> None:
    _add_recording(parser)
    add_option(parser, "--out", "output file: .csv, .parquet or .npz", metavar="FILE", type=Path, required=True)
    add_option(parser, "--finger", "finger to export, if there are several", default="", metavar="NAME")


def configure_import(parser: Parser) -> None:
    add_option(
        parser, "table", "text file, separated by commas, semicolons, tabs or blanks", metavar="TABLE", type=Path
    )
    add_option(parser, "--out", "output file for --recording and --poses", metavar="FILE.csv", type=Path, required=True)
    add_option(
        parser,
        "--columns",
        "quantity in each column: t,x,y,z,qw,qx,qy,qz, or - to ignore it; such as t,x,y,z,-,-,-",
        metavar="NAMES",
        required=True,
    )
    add_option(parser, "--unit-s", "unit of t in s; 0.001 for ms", default=1.0, metavar="S")
    add_option(parser, "--unit-m", "unit of x, y, z in m; 0.001 for mm", default=1.0, metavar="M")
    add_option(parser, "--rate", "rows per second of a table without times", metavar="HZ", type=float)
    add_option(parser, "--skip", "number of lines to skip at the start", default=0, metavar="N")


def configure_replay(parser: Parser) -> None:
    add_option(
        parser,
        "recording",
        "MCAP file; or poses (.csv, .npz, a shipped name) with --scene and --against",
        metavar="RECORDING",
    )
    add_option(parser, "--against", "reference forces: results, or the output of a replay", metavar="FORCES", type=Path)
    add_option(
        parser, "--tolerance", "largest allowed difference in N, N m and m", default=TOLERANCE, metavar="N", type=float
    )
    add_option(parser, "--scene", "scene that replaces the recorded one")
    add_option(parser, "--rig", "rig whose force limits replace the recorded ones")
    add_option(parser, "--rate", "tick rate for poses (default: 1000)", metavar="HZ", type=float)
    add_option(parser, "--plot", "plot both forces and their difference", metavar="FILE.png", type=plot_file)
    add_flag(parser, "--json", "print the result as JSON")
