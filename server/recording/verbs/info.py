"""`softfinger info`: print a summary of a recording."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from softfinger.server.recording.summary import summary


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="an .mcap of run --record, record or ctl")
    parser.add_argument("--json", action="store_true", help="print it as JSON, with rig and scene")


def run(args: argparse.Namespace) -> int:
    """Print the summary; return 0."""
    found = summary(args.recording)
    print(json.dumps(found) if args.json else "\n".join(_lines(found)))
    return 0


def _lines(found: dict[str, Any]) -> Iterator[str]:
    whole = "whole" if found["whole"] else f"cut short: {found['cut']}"
    yield f"{found['file']}: {found['bytes'] / 1e6:.1f} MB, {whole}"
    rate = f" at {found['rate_hz']:g} Hz" if isinstance(found["rate_hz"], int | float) else ""
    yield f"  {found['ticks']} ticks, {found['first_tick']} to {found['last_tick']}{rate}, {found['duration_s']:.3f} s"
    if found["missing"]:
        yield f"  {found['missing']} ticks are missing in {found['gaps']} gaps, the longest of {found['longest_gap']}"
    if found["dropped"]:
        yield f"  {found['dropped']} were left out since the disk was too slow"
    if found["events_dropped"]:
        yield f"  {found['events_dropped']} events were left out, too"
    if found["lost"]:
        yield f"  {found['lost']} did not arrive"
    device = found["device"]["name"] if isinstance(found["device"], dict) else "unknown"
    yield f"  scene {found['scene_name'] or 'unknown'}; device {device}"
    for name, finger in found["fingers"].items():
        modes = ", ".join(f"{mode} {count / finger['ticks']:.1%}" for mode, count in finger["modes"].items())
        force, torque = finger.get("force_max_n", 0.0), finger.get("torque_max_nm", 0.0)
        yield f"  {name or 'finger'}: {modes}; force up to {force:.3f} N, torque up to {torque:.4f} N m"
    for kind, count in found["events"].items():
        yield f"  {count} x {kind}"
    for mark in found["marks"]:
        yield f"  tick {mark['tick']}: {mark['label']}"
    for topic in found["topics"]:
        yield f"  topic {topic['name']}: {topic['messages']} of {topic['schema']}"
    versions = found["versions"] if isinstance(found["versions"], dict) else {}
    yield "  " + (", ".join(f"{name} {version}" for name, version in versions.items()) or "of an unknown version")
