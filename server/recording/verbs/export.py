"""`softfinger export`: convert the ticks of a recording to CSV, Parquet or npz."""

from __future__ import annotations

import argparse

from softfinger.drivers.poses import find_recording
from softfinger.server.arguments import check_distinct
from softfinger.server.recording.export import export


def run(args: argparse.Namespace) -> int:
    recording = find_recording(args.recording)
    check_distinct("--out", args.out, [recording])
    count = export(recording, args.out, args.finger)
    print(f"{args.out}: {count} ticks")
    return 0
