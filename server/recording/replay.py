"""`softfinger replay`: recompute a recording from its poses; compare forces, modes and contact points."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.arrays.grids import open_npz
from softfinger.config.errors import ConfigError, Different, RecordingError
from softfinger.config.files import open_input, read_input
from softfinger.config.load import build, load_rig, load_scene
from softfinger.drivers.poses import find_recording, load_poses
from softfinger.drivers.resample import resample
from softfinger.drivers.wrench_log import FORCE_COLUMNS
from softfinger.proxy.record import RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.offline.figures import make_figure, save
from softfinger.server.recording.compare import (
    COMPARED_FIELDS,
    READ_FIELDS,
    ReplayComparison,
    ReplayResult,
    compare,
    compare_run,
)
from softfinger.server.recording.results import read_results
from softfinger.server.recording.run import Run, load_run

Against = dict[str, dict[str, Array]]

FORCES_BYTES_MAX: Final = 1 << 30
SPANS_SHOWN: Final = 10
POINTS_MAX: Final = 4000


def run(args: argparse.Namespace) -> int:
    """Compare a recording with today's results; return 0. Raises Different, with its exit code, if a tick differs."""
    if not args.tolerance >= 0.0:
        raise ConfigError(f"--tolerance {args.tolerance} is not a tolerance: must be 0 or more")
    path = Path(args.recording)
    recorded = path.suffix.lower() == ".mcap"
    changes = {} if args.rate is None else {"servo.rate_hz": args.rate}
    rig = load_rig(args.rig or "replay", changes, dict.fromkeys(changes, "command line --rate"))
    if recorded:
        if args.rate is not None:
            raise ConfigError("--rate is for poses: a recording contains its rate")
        past = load_run(path, READ_FIELDS)
        if past.notes.get("every", 1) != 1:
            raise RecordingError(
                f"{path}: has one tick in {past.notes['every']}: a replay needs every tick: set every = 1"
            )
        scene = _find_scene(args.scene, past, path)
        if args.rig is None and "rig" in past.notes:
            rig = build(schema.Rig, past.notes["rig"], f"{path}: rig")
    else:
        find_recording(args.recording)
        if args.scene is None or args.against is None:
            raise ConfigError(f"{path}: a table has no scene, and only its poses are read: add --scene and --against")
        past, scene = _run_from_poses(args.recording, rig.servo.rate_hz), load_scene(args.scene)
    replayed = compare_run(past, scene, rig)
    against = _select_recorded(past) if args.against is None else _from_file(args.against, past)
    outcome = compare(past, replayed, against, args.tolerance)
    if args.plot is not None:
        draw(past, replayed, against, args.plot)
    print(json.dumps(_to_json(outcome)) if args.json else "\n".join(_format_lines(outcome, past)))
    if outcome.first is not None:
        first = outcome.first
        raise Different(
            f"tick {first.tick} ({first.seconds:.3f} s), {f'{first.finger} ' if first.finger else ''}{first.key}: "
            f"recorded {first.recorded!r}, recomputed {first.now!r}; "
            f"{outcome.different} of {outcome.compared} ticks differ"
        )
    if not outcome.compared:
        raise RecordingError(
            f"{path}: no tick can be compared: it starts in contact, is too short, or has a command in each touch"
        )
    return 0


def _find_scene(name: str | None, past: Run, path: Path) -> schema.Scene:
    if name is not None:
        return load_scene(name)
    if "scene" not in past.notes:
        raise ConfigError(f"{path}: does not contain its scene: add --scene")
    return build(schema.Scene, past.notes["scene"], f"{path}: scene")


def _run_from_poses(name: str, rate_hz: float) -> Run:
    """Return poses as a run that starts at tick 0."""
    poses = resample(load_poses(name), rate_hz)
    count = len(poses)
    zeros = Records(np.zeros((count, RECORD_SIZE)))
    fields = {key: zeros[key] for key in READ_FIELDS} | {
        "tick": np.arange(count, dtype=np.float64),
        "dt": np.full(count, round(1e9 / rate_hz) / 1e9),
        "probe.position": poses[:, :3],
        "probe.orientation": poses[:, 3:],
    }
    return Run({"": fields}, {"rate_hz": rate_hz}, [], "")


def _select_recorded(past: Run) -> Against:
    return {finger: {key: fields[key] for key in COMPARED_FIELDS} for finger, fields in past.fingers.items()}


def _from_file(path: Path, past: Run) -> Against:
    """Return the values of another file at the run's ticks, by number; raises RecordingError if it lacks a tick."""
    against: Against = {}
    for finger, fields in past.fingers.items():
        forces = _read_forces(path) if len(past.fingers) == 1 else None
        if forces is not None:
            numbers, values_by_key = forces
        else:
            rows = Records(read_results(path, finger))
            numbers, values_by_key = rows["tick"], {key: rows[key] for key in COMPARED_FIELDS}
        missing = ~np.isin(fields["tick"], numbers)
        if missing.any():
            raise RecordingError(
                f"{path}: has no tick {fields['tick'][missing][0]:.0f}, nor {missing.sum() - 1} more of the recording"
            )
        order = np.argsort(numbers, kind="stable")
        indices = order[np.searchsorted(numbers[order], fields["tick"])]
        against[finger] = {key: values[indices] for key, values in values_by_key.items()}
    return against


def _read_forces(path: Path) -> tuple[Array, dict[str, Array]] | None:
    """Return the forces in a file of the replay device: index of the read before each, and wrench; None if other."""
    try:
        if path.suffix.lower() == ".npz":
            with open_input(path) as file:
                archive = open_npz(file)
                if "read" not in archive.files:
                    return None
                reads = archive["read"].astype(np.float64)
                wrenches = np.column_stack([archive["force"], archive["torque"]])
        elif path.suffix.lower() == ".csv":
            header = ",".join(FORCE_COLUMNS)
            with open_input(path) as file:
                if file.readline(len(header) + 2).decode("ascii", "replace").strip() != header:
                    return None
            lines = read_input(path, FORCES_BYTES_MAX).decode("ascii").splitlines()
            table = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
            reads, wrenches = table[:, 0], table[:, 1:7]
        else:
            return None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # damaged bytes raise exceptions of many types
        raise RecordingError(f"{path}: not a file of forces: {error}") from error
    return reads, {"force": wrenches[:, :3], "torque": wrenches[:, 3:6]}


def _to_json(outcome: ReplayComparison) -> dict[str, Any]:
    plain = outcome._asdict() | {"equal": outcome.first is None and outcome.compared > 0}
    plain["first"] = None if outcome.first is None else outcome.first._asdict()
    plain["left_out"] = [span._asdict() for span in outcome.left_out]
    return plain


def _format_lines(outcome: ReplayComparison, past: Run) -> list[str]:
    lines = [f"{outcome.compared} of {outcome.ticks} ticks compared, {outcome.different} differ"]
    if past.cut:
        lines.append(f"  the recording is incomplete: {past.cut}")
    lines += [f"  {key}: largest difference {value:.3g}" for key, value in outcome.largest.items()]
    lines += [f"  ticks {s.first} to {s.last} are not compared: {s.why}" for s in outcome.left_out[:SPANS_SHOWN]]
    if len(outcome.left_out) > SPANS_SHOWN:
        lines.append(f"  and {len(outcome.left_out) - SPANS_SHOWN} stretches more")
    return lines


def draw(past: Run, replayed: ReplayResult, against: Against, path: Path) -> None:
    """Plot the force magnitude of each finger over time, recorded and recomputed, and the difference where compared."""
    drawing = make_figure(8.0, 2.0 + 2.0 * len(past.fingers))
    axes = drawing.subplots(2 * len(past.fingers), 1, sharex=True, squeeze=False)[:, 0]
    seconds = np.cumsum(past.first["dt"])
    plotted = np.unique(np.linspace(0, len(seconds) - 1, min(len(seconds), POINTS_MAX)).astype(int))
    for finger_index, finger in enumerate(past.fingers):
        recorded, recomputed = against[finger]["force"], replayed.field("force", finger_index)
        deviation = np.linalg.norm(recomputed - recorded, axis=1)
        deviation[~replayed.comparable] = np.nan
        above, below = axes[2 * finger_index], axes[2 * finger_index + 1]
        above.plot(seconds[plotted], np.linalg.norm(recorded, axis=1)[plotted], linewidth=1.6, label="then")
        above.plot(seconds[plotted], np.linalg.norm(recomputed, axis=1)[plotted], linewidth=0.8, label="now")
        above.set_ylabel(f"{finger} force [N]".strip())
        above.legend(frameon=False, fontsize="small")
        below.plot(seconds[plotted], deviation[plotted], linewidth=1.0)
        below.set_ylabel("difference [N]")
    axes[-1].set_xlabel("time [s]")
    save(drawing, path)
