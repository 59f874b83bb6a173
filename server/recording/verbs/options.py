"""Options of the verbs in this folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from softfinger.server.arguments import Parser
from softfinger.server.offline.figures import plot_file

TOLERANCE: Final = 1e-9
"""N, N m, m: possible difference between processors after many ticks; results on one machine are identical."""


def _add_recording(parser: Parser) -> None:
    kinds = "MCAP file, results or poses (.csv, .npz), or the name of a shipped recording"
    parser.argument("recording", "RECORDING", kinds)


def configure_info(parser: Parser) -> None:
    _add_recording(parser)
    parser.flag("--json", "print as JSON, with rig and scene")


def configure_export(parser: Parser) -> None:
    _add_recording(parser)
    parser.argument("--out", "FILE", "output file: .csv, .parquet or .npz", type=Path, required=True)
    parser.argument("--finger", "NAME", "finger to export, if there are several", default="")


def configure_import(parser: Parser) -> None:
    parser.argument("table", "TABLE", "text file, separated by commas, semicolons, tabs or blanks", type=Path)
    parser.argument("--out", "FILE.csv", "output file for --recording and --poses", type=Path, required=True)
    parser.argument(
        "--columns",
        "NAMES",
        "quantity in each column: t,x,y,z,qw,qx,qy,qz, or - to ignore it; such as t,x,y,z,-,-,-",
        required=True,
    )
    parser.argument("--unit-s", "S", "unit of t in s; 0.001 for ms", type=float, default=1.0)
    parser.argument("--unit-m", "M", "unit of x, y, z in m; 0.001 for mm", type=float, default=1.0)
    parser.argument("--rate", "HZ", "rows per second of a table without times", type=float)
    parser.argument("--skip", "N", "number of lines to skip at the start", type=int, default=0)


def configure_replay(parser: Parser) -> None:
    parser.argument(
        "recording", "RECORDING", "MCAP file; or poses (.csv, .npz, a shipped name) with --scene and --against"
    )
    parser.argument("--against", "FORCES", "reference forces: results, or the output of a replay", type=Path)
    parser.argument("--tolerance", "N", "largest allowed difference in N, N m and m", type=float, default=TOLERANCE)
    parser.argument("--scene", None, "scene that replaces the recorded one")
    parser.argument("--rig", None, "rig whose force limits replace the recorded ones")
    parser.argument("--rate", "HZ", "tick rate for poses (default: 1000)", type=float)
    parser.argument("--plot", "FILE.png", "plot both forces and their difference", type=plot_file)
    parser.flag("--json", "print the result as JSON")
