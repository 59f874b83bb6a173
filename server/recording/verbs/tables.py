"""`softfinger import`: convert poses of another program, a table of numbers in any layout, to a replayable file."""

from __future__ import annotations

import argparse
from pathlib import Path

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.server.arguments import check_distinct
from softfinger.server.recording.summary import extent_text
from softfinger.server.recording.tables import make_layout, read_table, write_poses


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
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


def run(args: argparse.Namespace) -> int:
    """Convert the table; return 0."""
    layout = make_layout(args.columns, args.unit_s, args.unit_m, args.rate, args.skip)
    if args.out.suffix.lower() != ".csv":
        raise ConfigError(f"--out {args.out}: poses are written as .csv")
    check_distinct("--out", args.out, [args.table])
    poses = read_table(args.table, layout)
    try:
        write_poses(args.out, poses)
    except OSError as error:
        raise RecordingError(f"{args.out}: cannot be written: {error.strerror or error}") from error
    extent = extent_text(poses.position.min(axis=0), poses.position.max(axis=0))
    print(f"{args.out}: {len(poses.t)} poses over {poses.t[-1]:.6g} s; {extent}")
    return 0
