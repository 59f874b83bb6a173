"""`softfinger info`, `export` and `import`: summary of a recording, and its conversion from and to other files."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import Any

from softfinger.config.errors import ConfigError
from softfinger.drivers.poses import find_recording
from softfinger.server.arguments import check_distinct
from softfinger.server.recording.export import export
from softfinger.server.recording.summary import format_extent, summarize
from softfinger.server.recording.tables import make_table_format, read_table, write_poses


def run_info(args: argparse.Namespace) -> int:
    info = summarize(args.recording)
    print(json.dumps(info) if args.json else "\n".join(_format_lines(info)))
    return 0


def _size_text(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def _format_lines(info: dict[str, Any]) -> Iterator[str]:
    state = "complete" if info["whole"] else f"incomplete: {info['cut']}"
    yield f"{info['file']}: {_size_text(info['bytes'])}, {state}"
    rate = f" at {info['rate_hz']:g} Hz" if isinstance(info["rate_hz"], int | float) else ""
    counted = "ticks" if any(finger["modes"] for finger in info["fingers"].values()) else "poses"
    yield f"  {info['ticks']} {counted}, {info['first_tick']} to {info['last_tick']}{rate}, {info['duration_s']:.3f} s"
    if info["missing"]:
        yield f"  {info['missing']} ticks are missing in {info['gaps']} gaps, the longest of {info['longest_gap']}"
    if info["dropped"]:
        yield f"  {info['dropped']} were not recorded because the disk was too slow"
    if info["events_dropped"]:
        yield f"  {info['events_dropped']} events were not recorded either"
    if info["lost"]:
        yield f"  {info['lost']} did not arrive"
    device = info["device"].get("name") if isinstance(info["device"], dict) else None
    if info["topics"]:
        yield f"  scene {info['scene_name'] or 'unknown'}; device {device or 'unknown'}"
    for name, finger in info["fingers"].items():
        yield f"  {name or 'finger'}: {'; '.join(_format_finger_parts(finger))}"
    for kind, count in info["events"].items():
        yield f"  {count} x {kind}"
    for mark in info["marks"]:
        yield f"  tick {mark['tick']}: {mark['label']}"
    for topic in info["topics"]:
        yield f"  topic {topic['name']}: {topic['messages']} of {topic['schema']}"
    versions = info["versions"] if isinstance(info["versions"], dict) else {}
    if info["topics"]:
        yield "  " + (", ".join(f"{name} {version}" for name, version in versions.items()) or "of an unknown version")


def _format_finger_parts(finger: dict[str, Any]) -> Iterator[str]:
    if finger["modes"]:
        yield ", ".join(f"{mode} {count / finger['ticks']:.1%}" for mode, count in finger["modes"].items())
        force, torque = finger.get("force_max_n", 0.0), finger.get("torque_max_nm", 0.0)
        yield f"force up to {force:.3f} N, torque up to {torque:.4f} N m"
    else:
        yield "no forces"
    if "position_min_m" in finger:
        yield format_extent(finger["position_min_m"], finger["position_max_m"])


def run_export(args: argparse.Namespace) -> int:
    recording = find_recording(args.recording)
    check_distinct("--out", args.out, [recording])
    count = export(recording, args.out, args.finger)
    print(f"{args.out}: {count} ticks")
    return 0


def run_import(args: argparse.Namespace) -> int:
    table_format = make_table_format(args.columns, args.unit_s, args.unit_m, args.rate, args.skip)
    if args.out.suffix.lower() != ".csv":
        raise ConfigError(f"--out {args.out}: poses are written as .csv")
    check_distinct("--out", args.out, [args.table])
    poses = read_table(args.table, table_format)
    write_poses(args.out, poses)
    extent = format_extent(poses.position.min(axis=0), poses.position.max(axis=0))
    print(f"{args.out}: {len(poses.t)} poses over {poses.t[-1]:.6g} s; {extent}")
    return 0
