"""Replay of recorded poses with today's code, and comparison with the recorded results, tick by tick.

The internal state of a contact is not recorded. Therefore comparison starts where this state is known to be empty: at
the daemon's first tick or, after each interruption (missing ticks, a command, a force withheld by the driver), at the
first tick in free space at which the earlier history has no influence. After a disarmed stretch, which a guard bit
marks, the ramp starts from zero in both the recording and the replay, so comparison does not wait for its end.

Replay and comparison are in one file because both depend on the same parts of a run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import accumulate, pairwise
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.load import apply_overrides, describe
from softfinger.config.overrides import to_indexed_key
from softfinger.drivers.base import HELD, WITHHELD, DeviceInfo
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.kernels.jit.pack import PackedTree, flatten, packed
from softfinger.proxy.record import FREE, NAMED, RECORD_SIZE
from softfinger.server.loop.clock import NS_PER_S, compute_period_ns
from softfinger.server.loop.guard import (
    DISARMED,
    FORCE_CLAMPED,
    POSE_FROZEN,
    POSE_JUMPED,
    POSE_REFUSED,
    RAMPING,
    TORQUE_CLAMPED,
)
from softfinger.server.loop.tick import Tuning, make_start_memory
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import run_ticks
from softfinger.server.progress import CHUNK, show_progress
from softfinger.server.recording.run import Run

Mask = NDArray[np.bool_]

COMPARED_FIELDS: Final = ("force", "torque", "contact.mode", "contact.object", "contact.point")
READ_FIELDS: Final = ("timestamp", "servo.guard", "servo.device", "servo.missed", *COMPARED_FIELDS)
"""Fields of a recording that a comparison reads."""

COMMAND_TOLERANCE_S: Final = 0.5
"""The event of a command is published after its execution, so the force may differ for this time before the event.
The answering thread has normal priority; on a busy machine its longest delays are tenths of a second.
"""
COMMAND_TICKS: Final = 2
"""The tick named by an event may have started before the command; the second tick after it has not."""
MEMORY_TIME_CONSTANTS: Final = 40.0
"""Number of time constants after which the velocity filter has no memory: exp(-40) is below the last bit of float64."""

_STORED: Final = ("servo.guard", *COMPARED_FIELDS)
_SLICES: Final[dict[str, slice]] = {
    name: slice(end - NAMED[name].size, end)
    for name, end in zip(_STORED, accumulate(NAMED[name].size for name in _STORED), strict=True)
}
_COLUMNS: Final = [NAMED[name].at + i for name in _STORED for i in range(NAMED[name].size)]
"""Columns of a record that a replay stores, and their positions there."""

_STATE_COMMANDS: Final = {"set_params", "drive", "heartbeat", "heartbeat_missed"}


class Difference(NamedTuple):
    """Two values of one key in a tick, `seconds` after the first tick of the recording."""

    tick: int
    seconds: float
    finger: str
    key: str
    recorded: float
    now: float


class SkippedTicks(NamedTuple):
    """Ticks from `first` to `last` that are not compared, and the reason."""

    first: int
    last: int
    why: str


class ReplayComparison(NamedTuple):
    """Result of a comparison.

    first     first difference; None if there is none
    largest   largest difference of each key
    left_out  ticks that were not compared
    """

    ticks: int
    compared: int
    different: int
    first: Difference | None
    largest: dict[str, float]
    left_out: list[SkippedTicks]


class ReplayResult(NamedTuple):
    """Results of a run's ticks with today's code.

    columns     (n, fingers, ...)  compared columns of the records
    comparable  (n,)               ticks that can be compared
    left_out                       the other ticks, with reasons
    bodies                         poses as `Run.bodies`; NaN if the scene has other bodies
    """

    columns: Array
    comparable: Mask
    left_out: list[SkippedTicks]
    bodies: Array

    def field(self, name: str, finger_index: int) -> Array:
        """Return a field of a finger, (n, size)."""
        return self.columns[:, finger_index, _SLICES[name]]


def compare_run(run: Run, scene: schema.Scene, rig: schema.Rig) -> ReplayResult:
    """Compute every tick of a run with today's step and guard; raises ConfigError for a scene with other fingers."""
    names = [finger.name for finger in scene.fingers]
    if len(names) != len(run.fingers) or (len(names) > 1 and names != list(run.fingers)):
        raise ConfigError(
            f"the scene has the fingers {', '.join(names) or 'of one'}, but the recording has {', '.join(run.fingers)}"
        )
    ticks = run.first["tick"].astype(np.int64)
    poses = np.stack([np.column_stack((f["probe.position"], f["probe.orientation"])) for f in run.fingers.values()], 1)
    poses[_find_bit(run, POSE_REFUSED | POSE_JUMPED | POSE_FROZEN)] = np.nan  # the device's pose is not recorded
    free = np.all(np.stack([f["contact.mode"] for f in run.fingers.values()], axis=1) == FREE, axis=1)
    recorded_guards = np.stack([f["servo.guard"] for f in run.fingers.values()], axis=1)
    devices, settling_ticks = _read_device_infos(run), _find_settling_ticks(scene, run.rate_hz)
    columns = np.empty((len(ticks), len(names), len(_COLUMNS)))
    bodies = np.full_like(run.bodies.poses, np.nan)
    comparable, left_out = np.zeros(len(ticks), dtype=bool), list[SkippedTicks]()
    ramp = round(rig.commands.ramp_s * run.rate_hz)
    with show_progress("replaying", len(ticks)) as advance:
        for part in _split_run(run, scene, ticks, ramp):
            block = slice(part.start, part.stop)
            tuning = make_tuning(part.scene, rig.guard, devices)
            _simulate(run, part, tuning, poses[block], (columns[block], bodies), advance)
            start = part.start
            if ticks[start] > 0:
                modes, guards = (columns[block, :, _SLICES[name]][..., 0] for name in ("contact.mode", "servo.guard"))
                is_at_rest = free[block] & np.all((modes == FREE) & (guards == recorded_guards[block]), axis=1)
                is_at_rest &= np.all((guards == 0.0) | (part.armed & (guards == RAMPING)), axis=1)
                is_at_rest[:settling_ticks] = False
                if part.scene.world is not None:  # the poses of its bodies at this tick are not recorded
                    is_at_rest[:] = False
                start += int(np.argmax(is_at_rest)) if is_at_rest.any() else len(is_at_rest)
            comparable[start : part.stop] = True
            left_out += _span(ticks, part.start, start, part.why)
    for row in _read_command_changes(run, scene, ticks, ramp):  # may be executed before its event
        first = max(0, row - ramp - round(COMMAND_TOLERANCE_S * run.rate_hz))
        comparable[first:row] = False
        left_out += _span(
            ticks, first, row, "the time of the following command is not recorded, or it was not yet executed"
        )
    withheld = _find_withheld(run)
    comparable[withheld] = False
    if withheld.any():
        left_out.append(
            SkippedTicks(
                int(ticks[withheld][0]), int(ticks[withheld][-1]), "the force was withheld or disarmed in between"
            )
        )
    return ReplayResult(
        columns,
        comparable,
        left_out + _span(ticks, _find_known_end(run, scene, ticks), len(ticks), "another scene or rig was set"),
        bodies,
    )


def _simulate(
    run: Run, part: _Segment, tuning: Tuning, poses: Array, out: tuple[Array, Array], advance: Callable[[int], None]
) -> None:
    """Simulate the poses (n, fingers, 7) of a part from an empty state.

    Calls `advance` with the ticks of the run so far. Writes the columns (n, fingers, ...) and the poses of bodies
    (`ReplayResult`) into `out`.
    """
    columns, bodies = out
    period = compute_period_ns(run.rate_hz) / NS_PER_S
    first, initial_memory = run.first, make_start_memory(tuning.scene)
    begin_bodies(tuning.scene, period)
    first_tick = int(first["tick"][part.start])
    # A device with its own clock is stepped one period per tick; other devices also for each missed deadline.
    has_own_clock = all(info.own_clock for info in _read_device_infos(run))
    skipped = 0.0 if has_own_clock or "servo.missed" not in first else float(first["servo.missed"][part.start])
    memory = initial_memory._replace(world=initial_memory.world._replace(time=(first_tick + skipped) * period))
    dts = np.ascontiguousarray(first["dt"][part.start : part.stop])
    scene_and_guard, carried = packed(tuning), PackedTree(initial_memory, flatten(memory))
    records = np.zeros((min(len(poses), CHUNK), poses.shape[1], RECORD_SIZE))
    for start, end in _split_ticks(run.bodies.ticks - first_tick, len(poses)):
        block = slice(start, end)
        rows = records[: end - start]
        run_ticks(scene_and_guard, carried, poses[block], dts[block], period, first_tick + start, rows)
        check_bodies(tuning.scene)
        columns[block] = rows[:, :, _COLUMNS]
        advance(part.start + end)
        if tuning.scene.bodies is not None:
            owner = tuning.scene.bodies.block.owner
            if tuple(owner.names) == run.bodies.names:
                body_poses = np.hstack([owner.data.xpos[owner.moving], owner.data.xquat[owner.moving]])
                bodies[run.bodies.ticks == first_tick + end - 1] = body_poses


def _split_ticks(ticks: NDArray[np.int64], count: int) -> Iterator[tuple[int, int]]:
    """Split 0 to `count` into stretches of at most CHUNK ticks, which end after each of `ticks`."""
    ends = {*range(CHUNK, count, CHUNK), count, *(int(tick) + 1 for tick in ticks if 0 <= tick < count)}
    return pairwise([0, *sorted(ends)])


def _span(ticks: NDArray[np.int64], start: int, stop: int, why: str) -> list[SkippedTicks]:
    return [SkippedTicks(int(ticks[start]), int(ticks[stop - 1]), why)] if stop > start else []


def _find_bit(run: Run, bit: int) -> Mask:
    """Return whether the guard of each finger set this bit, (n, fingers)."""
    guards = np.stack([fields["servo.guard"] for fields in run.fingers.values()], axis=1)
    has: Mask = (guards.astype(np.int64) & bit) != 0
    return has


def _find_withheld(run: Run) -> Mask:
    """Return the ticks (n,) in which a hand received another force than the step's, for reasons not in the poses."""
    device = np.stack([fields["servo.device"] for fields in run.fingers.values()], axis=1)
    withheld: Mask = np.any(np.isin(device, (WITHHELD, HELD)) | _find_bit(run, DISARMED), axis=1)
    # Disarming has started: the limits are zero, but the guard bit is not set yet.
    for bit, key in ((FORCE_CLAMPED, "force"), (TORQUE_CLAMPED, "torque")):
        none = np.stack([~fields[key].any(axis=1) for fields in run.fingers.values()], axis=1)
        withheld |= np.any(_find_bit(run, bit) & none, axis=1)
    return withheld


def _read_device_infos(run: Run) -> list[DeviceInfo]:
    """Return the properties of the devices, if the recording has them."""
    fingers = run.notes.get("fingers")
    try:
        return (
            [msgspec.convert(finger["device"], DeviceInfo) for finger in fingers] if isinstance(fingers, list) else []
        )
    except (msgspec.ValidationError, KeyError, TypeError):
        return []


def _find_settling_ticks(scene: schema.Scene, rate_hz: float) -> int | None:
    """Return the ticks after which the history has no influence; None if an effect never forgets it."""
    effects = [*scene.effect, *(effect for obj in scene.object for effect in obj.effect)]
    if any(isinstance(effect, schema.StickSlip) for effect in effects):
        return None
    slowest = max(finger.probe.velocity_time_constant_s for finger in scene.fingers)
    return math.ceil(MEMORY_TIME_CONSTANTS * slowest * rate_hz) + 1


def compare(
    run: Run, replayed: ReplayResult, against: Mapping[str, Mapping[str, Array]], tolerance: float
) -> ReplayComparison:
    """Compare a replay with the recorded or other values.

    Parameters
    ----------
    run
        Recording.
    replayed
        Its results with today's code.
    against
        Values to compare with, (n,) or (n, size), by finger and key.
    tolerance
        Largest allowed difference of a component, N, N m or m; modes and objects must be equal.
    """
    ticks = run.first["tick"].astype(np.int64)
    differs = np.zeros(len(ticks), dtype=bool)
    largest: dict[str, float] = {}
    differences: list[Difference] = []
    for finger_index, finger in enumerate(run.fingers):
        for key, values in against[finger].items():
            field = NAMED[key]
            recomputed = replayed.field(key, finger_index)
            recorded = values.reshape(len(values), -1)
            with np.errstate(invalid="ignore"):
                deviation = np.abs(recomputed - recorded)
            deviation[(recomputed == recorded) | (np.isnan(recomputed) & np.isnan(recorded))] = 0.0
            deviation[np.isnan(deviation)] = math.inf
            deviation[~replayed.comparable] = 0.0
            largest[key] = max(largest.get(key, 0.0), float(deviation.max(initial=0.0)))
            rows, parts = np.nonzero(deviation > (tolerance if field.kind == "float" else 0.0))
            differs[rows] = True
            if len(rows):
                row, part = int(rows[0]), int(parts[0])
                name = f"{key}[{part}]" if field.size > 1 else key
                seconds = float(np.sum(run.first["dt"][1 : row + 1]))
                differences.append(
                    Difference(
                        int(ticks[row]), seconds, finger, name, float(recorded[row, part]), float(recomputed[row, part])
                    )
                )
    differences += _compare_bodies(run, replayed, tolerance, differs, largest)
    first = min(differences, key=lambda difference: difference.tick, default=None)
    return ReplayComparison(
        len(ticks), int(replayed.comparable.sum()), int(differs.sum()), first, largest, replayed.left_out
    )


def _compare_bodies(
    run: Run, replayed: ReplayResult, tolerance: float, differs: Mask, largest: dict[str, float]
) -> Iterator[Difference]:
    """Yield the first difference of each body's pose, m or quaternion component; update `differs` and `largest`."""
    ticks, names, recorded = run.bodies
    numbers = run.first["tick"].astype(np.int64)
    rows = np.searchsorted(numbers, ticks)
    is_comparable = np.isin(ticks, numbers)
    is_comparable[is_comparable] = replayed.comparable[rows[is_comparable]]
    for body_index, name in enumerate(names):
        recomputed = replayed.bodies[:, body_index]
        deviation = np.where(
            is_comparable[:, None] & ~np.isnan(recomputed), np.abs(recomputed - recorded[:, body_index]), 0.0
        )
        for key, part in (("position", slice(0, 3)), ("orientation", slice(3, 7))):
            block = deviation[:, part]
            largest[f"{name}.{key}"] = float(block.max(initial=0.0))
            at, component = np.nonzero(block > tolerance)
            differs[rows[at]] = True
            if len(at):
                row, k = int(at[0]), int(component[0])
                seconds = float(np.sum(run.first["dt"][1 : rows[row] + 1]))
                values = float(recorded[row, body_index, part][k]), float(recomputed[row, part][k])
                yield Difference(int(ticks[row]), seconds, "", f"{name}.{key}[{k}]", *values)


class _Segment(NamedTuple):
    """Consecutive ticks that are simulated from an empty state.

    start, stop  rows of the recording, `stop` excluded
    scene        scene of these ticks
    why          reason why they do not continue the previous part
    armed        whether the part starts at the end of a disarmed stretch
    """

    start: int
    stop: int
    scene: schema.Scene
    why: str
    armed: bool


def _split_run(run: Run, scene: schema.Scene, ticks: NDArray[np.int64], ramp: int) -> Iterator[_Segment]:
    """Split the run where its state is unknown."""
    breaks = {0: "the recording starts in the middle of a run"}
    for row in (np.flatnonzero(np.diff(ticks) != 1) + 1).tolist():
        breaks[row] = f"{ticks[row] - ticks[row - 1] - 1} ticks before it are missing"
    for row in _find_rows_after(_find_withheld(run)):
        breaks[row] = "the force was withheld or disarmed"
    armed = set(_find_rows_after(np.any(_find_bit(run, DISARMED), axis=1)))
    changes = _read_command_changes(run, scene, ticks, ramp)
    breaks |= dict.fromkeys(changes, "a command precedes it")
    end = _find_known_end(run, scene, ticks)
    starts = sorted(row for row in breaks if row < end)
    for start, stop in pairwise([*starts, end]):
        if changes.get(start):
            scene = apply_overrides(scene, changes[start], "the recording's commands")
        yield _Segment(start, stop, scene, breaks[start], start in armed)


def _find_rows_after(mask: Mask) -> list[int]:
    """Return the row after each stretch of true values."""
    return (np.flatnonzero(mask[:-1] & ~mask[1:]) + 1).tolist()


def _read_command_changes(
    run: Run, scene: schema.Scene, ticks: NDArray[np.int64], ramp: int
) -> dict[int, dict[str, Any]]:
    """Return the changes made by commands: dotted keys by the first row with the full effect, after `ramp` ticks."""
    changes: dict[int, dict[str, Any]] = {}
    for event in run.events:
        if event["kind"] == "command" and event["name"] in _STATE_COMMANDS:
            row = int(np.searchsorted(ticks, event["tick"] + COMMAND_TICKS + ramp))
            changes.setdefault(row, {}).update(_read_changes(scene, event) or {})
    return changes


def _read_changes(scene: schema.Scene, event: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the changes of a command, by dotted key of the scene with indices; None if its event lacks them."""
    content = event.get("what")
    if not isinstance(content, dict):
        return None
    if event["name"] == "set_params":
        if not all(isinstance(change, dict) and "to" in change for change in content.values()):
            return None
        mapping = describe(scene)
        return {to_indexed_key(mapping, key): change["to"] for key, change in content.items()}
    if event["name"] == "drive":
        scene_index = next((i for i, obj in enumerate(scene.object) if obj.name == content.get("object")), None)
        return None if scene_index is None else {
            f"object.{scene_index}.{key}": value for key, value in content.items() if key != "object"
        }  # fmt: skip
    return {}


def _find_known_end(run: Run, scene: schema.Scene, ticks: NDArray[np.int64]) -> int:
    """Return the first row at which the scene is unknown, or the number of rows."""
    for event in run.events:
        name, kind = event["name"], event["kind"]
        unknown = (kind, name) in (("command", "set_scene"), ("command", "reset_world"), ("lifecycle", "replaced"))
        if kind == "command" and name in _STATE_COMMANDS:
            unknown = _read_changes(scene, event) is None
        if unknown:
            return int(np.searchsorted(ticks, event["tick"] - COMMAND_TOLERANCE_S * run.rate_hz))
    return len(ticks)
