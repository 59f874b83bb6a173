"""`softfinger simulate`: run the servo's tick offline, as fast as possible, over poses or with simulated devices."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.load import describe, load_rig, load_scene
from softfinger.proxy.record import AT, CAUSE_NAMES, FREE, MODE_NAMES
from softfinger.server.arguments import check_distinct, find_default_rig, parse_files_by_finger
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.figures import make_figure, save
from softfinger.server.offline.scene_messages import NO_MESSAGES, SceneMessages
from softfinger.server.offline.simulate import load_finger_poses, simulate_devices, simulate_poses
from softfinger.server.progress import name_warmup
from softfinger.server.recording.results import RunContext, write_blocks
from softfinger.server.recording.summary import format_extent
from softfinger.server.recording.writer import list_package_versions

POINTS_MAX: Final = 2000
"""Largest number of ticks drawn; evenly selected from a longer run."""
SHADES: Final = {"rolling": "#cfe3f5", "sliding": "#fbe0c3"}


COLUMNS: Final = (
    AT.tick,
    AT.dt,
    AT.contact_penetration,
    *range(AT.force, AT.force + 3),
    AT.contact_rolled,
    AT.contact_spin,
    AT.contact_mode,
)


def draw_run(curves: Array, path: Path) -> None:
    """Draw the COLUMNS (n, 9) of one run's records and save the figure as `path`."""
    tick, dt, penetration, x, y, z, rolled, spin, mode = curves.T
    drawing = make_figure(8.0, 5.5)
    depth, forces, turns = drawing.subplots(3, 1, sharex=True)
    seconds = (tick - tick[0]) * dt[0]
    few = np.unique(np.linspace(0, len(tick) - 1, min(len(tick), POINTS_MAX)).astype(int))

    def draw(axes: Any, values: Array, label: str) -> None:
        axes.plot(seconds[few], values[few], linewidth=1.2, label=label)

    draw(depth, 1e3 * penetration, "penetration")
    depth.set_ylabel("depth [mm]")
    for values, axis in ((x, "x"), (y, "y"), (z, "z")):
        draw(forces, values, f"${axis}$")
    draw(forces, np.linalg.norm(curves[:, 3:6], axis=1), "norm")
    forces.set_ylabel("force on the hand [N]")
    draw(turns, np.rad2deg(rolled), "rolled")
    draw(turns, np.rad2deg(spin), "torsion")
    turns.set(xlabel="time [s]", ylabel="angle [deg]")
    for axes in (depth, forces, turns):
        _shade(axes, seconds, mode, has_legend=axes is depth)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
        axes.margins(x=0.0)
    save(drawing, path)


def _shade(axes: Any, seconds: Array, modes: Array, has_legend: bool) -> None:
    """Draw a band for each interval in contact; if `has_legend`, each mode is in the legend once."""
    starts = np.flatnonzero(np.diff(modes, prepend=np.nan))
    ends = np.append(starts[1:], len(modes) - 1)
    unlabelled = set(SHADES) if has_legend else set()
    for start, end in zip(starts, ends, strict=True):
        mode = int(modes[start])
        if mode == FREE:
            continue
        name = MODE_NAMES[mode]
        axes.axvspan(
            seconds[start], seconds[end], color=SHADES[name], linewidth=0, label=name if name in unlabelled else None
        )
        unlabelled.discard(name)


DURATION_S = 10.0
"""Default duration of a run with simulated devices."""


def run(args: argparse.Namespace) -> int:
    scene_changes = {} if args.method is None else {"rolling.method": args.method}
    rig_changes = {} if args.rate is None else {"servo.rate_hz": args.rate}
    rig_name = args.rig or ("replay" if args.device is None else find_default_rig(args.scene, "simulated"))
    if args.device is not None:
        rig_changes |= {f"{table}.driver": args.device for table in load_rig(rig_name).tables}
    elif args.duration is not None:
        raise ConfigError("--duration needs --device: poses have their own duration")
    scene = load_scene(args.scene, scene_changes, {"rolling.method": "command line --method"})
    sources = {key: f"command line --{'rate' if key == 'servo.rate_hz' else 'device'}" for key in rig_changes}
    rig = load_rig(rig_name, rig_changes, sources)
    fingers = [finger.name for finger in scene.fingers]
    rate = rig.servo.rate_hz
    messages = SceneMessages(scene, rate) if args.out.suffix.lower() == ".mcap" else NO_MESSAGES
    if args.device is None:
        files = parse_files_by_finger(args.poses, "--poses")
        check_distinct("--out", args.out, files.values())
        poses = load_finger_poses(fingers, files, rate)
        blocks = simulate_poses(make_tuning(scene, rig.guard), poses, rate, messages)
    else:
        blocks = simulate_devices(scene, rig, DURATION_S if args.duration is None else args.duration, messages)
    summaries = [Summary(args.plot is not None) for _ in fingers]
    about = {
        "scene": describe(scene), "scene_name": str(args.scene), "rig": describe(rig), "rate_hz": rate,
        "versions": list_package_versions(),
    }  # fmt: skip
    with name_warmup(args.scene):
        write_blocks(args.out, fingers, add_summaries(blocks, summaries), RunContext(about, messages.pending))
    for name, summary in zip(fingers, summaries, strict=True):
        single = len(fingers) == 1
        if args.plot is not None:
            picture = args.plot if single else args.plot.with_stem(f"{args.plot.stem}-{name}")
            draw_run(np.concatenate(summary.curves), picture)
        label = f"{args.out}" if single else f"{args.out}, {name}"
        print(f"{label}: {summary.ticks} ticks at {rate:g} Hz; {summary}")
    return 0


def add_summaries(blocks: Iterable[Array], summaries: Sequence[Summary]) -> Iterator[Array]:
    """Yield blocks (m, fingers, RECORD_SIZE) unchanged, and add the records of each finger to its summary."""
    for block in blocks:
        for index, summary in enumerate(summaries):
            summary.add(block[:, index])
        yield block


class Summary:
    """Statistics of a finger's run for the printed line, and the curves of its plot if one is drawn."""

    def __init__(self, with_curves: bool) -> None:
        self.curves: list[Array] = []
        self.ticks, self._with_curves, self._peak = 0, with_curves, 0.0
        self._lowest, self._highest = np.full(3, np.inf), np.full(3, -np.inf)
        self._modes = np.zeros(len(MODE_NAMES), int)
        self._causes = np.zeros(len(CAUSE_NAMES), int)

    def add(self, records: Array) -> None:
        """Add records (m, RECORD_SIZE) that follow those added before."""
        self.ticks += len(records)
        self._modes += np.bincount(records[:, AT.contact_mode].astype(int), minlength=len(MODE_NAMES))
        self._causes += np.bincount(records[:, AT.contact_cause].astype(int), minlength=len(CAUSE_NAMES))
        strongest = np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1).max(initial=0.0)
        self._peak = max(self._peak, float(strongest))
        positions = records[:, AT.probe_position : AT.probe_position + 3]
        self._lowest = np.minimum(self._lowest, positions.min(axis=0, initial=np.inf))
        self._highest = np.maximum(self._highest, positions.max(axis=0, initial=-np.inf))
        if self._with_curves:
            self.curves.append(records[:, COLUMNS])

    def __str__(self) -> str:
        modes = ", ".join(
            f"{name} {count / self.ticks:.1%}" for name, count in zip(MODE_NAMES, self._modes, strict=True)
        )
        counts = list(zip(CAUSE_NAMES, self._causes, strict=True))[1:]
        changes = ", ".join(f"{count} {name}" for name, count in counts if count)
        if not changes:
            extent = format_extent(self._lowest.tolist(), self._highest.tolist())
            changes = f"no contact, the fingertip's centre moved {extent}"
        return f"{modes}; {changes}; largest force {self._peak:.3f} N"
