"""`bench simulate`: speed of `simulate` relative to real time, from the start of the program to the file."""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.drivers.poses import Poses, load_poses
from softfinger.drivers.resample import close_loop, resample
from softfinger.server.progress import show_progress
from softfinger.server.recording.results import SUFFIXES
from softfinger.server.recording.tables import write_poses
from softfinger.tools.measure import draw_bars, show_and_draw

RATE_HZ: Final = 1000.0


def run(args: argparse.Namespace) -> int:
    ticks, rounds = args.ticks, args.rounds
    durations: dict[str, list[tuple[float, float]]] = {ending: [] for ending in SUFFIXES}
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        poses = Path(folder, "poses.csv")
        with show_progress("first run, which compiles kernels that are not cached"):
            write_poses(poses, load_motion(args.poses, ticks))
            simulate(args.scene, poses, Path(folder, "warm.npz"))
        with show_progress("simulating", rounds * len(SUFFIXES)) as advance:
            for turn in range(rounds):
                for place, ending in enumerate(SUFFIXES):
                    durations[ending].append(simulate(args.scene, poses, Path(folder, f"results{ending}")))
                    advance(turn * len(SUFFIXES) + place + 1)
    rows = [{"format": ending[1:]} | summarize(turns, ticks) for ending, turns in durations.items()]
    lines = [
        f"{ticks} ticks on {args.scene}, poses from CSV, with the start of the program; {rounds} repetitions of each"
    ]
    lines += [
        f"  {row['format']:<5}{row['seconds']:7.2f} s, median {row['median_seconds']:.2f}, "
        f"processor {row['cpu_s']:.2f}: {row['times_real_time']:6.1f} x real time"
        for row in rows
    ]
    result = {"scene": args.scene, "ticks": ticks, "rate_hz": RATE_HZ, "formats": rows}
    speeds = {row["format"]: row["times_real_time"] for row in rows}
    return show_and_draw(args, result, lines, lambda path: draw_bars(path, speeds, "times real time"))


def load_motion(recording: str, ticks: int) -> Poses:
    """Return the recording as a loop of `ticks` poses."""
    once = close_loop(resample(load_poses(recording), RATE_HZ), RATE_HZ)
    rows = np.resize(once, (ticks, once.shape[1]))
    return Poses(np.arange(ticks) / RATE_HZ, rows[:, :3], rows[:, 3:])


def simulate(scene: str, poses: Path, out: Path) -> tuple[float, float]:
    """Run the program once and remove its file; returns wall-clock and processor time, s."""
    words = ["simulate", "--scene", scene, "--poses", str(poses), "--out", str(out)]
    before, begun = measure_children_s(), time.perf_counter()
    ended = subprocess.run(
        [sys.executable, "-m", "softfinger.server.cli", *words], capture_output=True, text=True, check=False
    )
    duration = time.perf_counter() - begun, measure_children_s() - before
    out.unlink(missing_ok=True)
    if ended.returncode:
        raise ConfigError(f"simulate failed: {ended.stderr.strip()}")
    return duration


def measure_children_s() -> float:
    """Return the processor time of finished child processes."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def summarize(turns: list[tuple[float, float]], ticks: int) -> dict[str, Any]:
    """Return the fastest run and the median. Compare the fastest: other programs share the machine."""
    walls, cpus = zip(*turns, strict=True)
    return {
        "seconds": min(walls),
        "median_seconds": float(np.median(walls)),
        "cpu_s": min(cpus),
        "times_real_time": ticks / RATE_HZ / min(walls),
    }
