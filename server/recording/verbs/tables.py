"""`softfinger import`: convert poses of another program, a table of numbers in any layout, to a replayable file."""

from __future__ import annotations

import argparse

from softfinger.config.errors import ConfigError
from softfinger.server.arguments import check_distinct
from softfinger.server.recording.summary import format_extent
from softfinger.server.recording.tables import make_layout, read_table, write_poses


def run(args: argparse.Namespace) -> int:
    layout = make_layout(args.columns, args.unit_s, args.unit_m, args.rate, args.skip)
    if args.out.suffix.lower() != ".csv":
        raise ConfigError(f"--out {args.out}: poses are written as .csv")
    check_distinct("--out", args.out, [args.table])
    poses = read_table(args.table, layout)
    write_poses(args.out, poses)
    extent = format_extent(poses.position.min(axis=0), poses.position.max(axis=0))
    print(f"{args.out}: {len(poses.t)} poses over {poses.t[-1]:.6g} s; {extent}")
    return 0
