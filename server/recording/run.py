"""Complete run read from a recording: ticks of all fingers, events and metadata."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.config.errors import RecordingError
from softfinger.drivers.poses import POSES_MAX, find_rate
from softfinger.server.recording.reader import (
    End,
    Event,
    Note,
    RecordedWorld,
    TickBlock,
    explain_no_tick,
    read_contents,
)

_REQUIRED: Final = ("tick", "dt", "probe.position", "probe.orientation")


class BodyPoses(NamedTuple):
    """Poses of the bodies of a [world] at some of the ticks.

    ticks  (m,)       pose after the step of this tick
    names  (n,)
    poses  (m, n, 7)  position m, quaternion w, x, y, z, body to world
    """

    ticks: NDArray[np.int64]
    names: tuple[str, ...]
    poses: Array


NO_BODIES: Final = BodyPoses(np.empty(0, np.int64), (), np.empty((0, 0, 7)))


class Run(NamedTuple):
    """Ticks that all fingers have in common.

    fingers  fields of each finger by name, with telemetry names, (n,) or (n, size) each
    notes    tables of metadata
    events   in file order
    cut      reason why the file is incomplete; empty for a complete one
    """

    fingers: dict[str, dict[str, Array]]
    notes: dict[str, Any]
    events: list[dict[str, Any]]
    cut: str
    bodies: BodyPoses = NO_BODIES

    @property
    def first(self) -> dict[str, Array]:
        """Fields of the first finger; `tick` and `dt` are the same for all."""
        return next(iter(self.fingers.values()))

    @property
    def rate_hz(self) -> float:
        """Rate of the loop, as in the metadata, else from the shortest time step."""
        rate = self.notes.get("rate_hz")
        return float(rate) if isinstance(rate, int | float) else find_rate(float(self.first["dt"].min()))


def load_run(path: Path, fields: tuple[str, ...]) -> Run:
    """Read the poses and these fields of a recording.

    Raises RecordingError if the file has no ticks, too many, or lacks a field.
    """
    blocks: dict[str, list[dict[str, Array]]] = {}
    notes: dict[str, Any] = {}
    events: list[dict[str, Any]] = []
    worlds: list[dict[str, Any]] = []
    end, count = End([], ""), 0
    for part in read_contents(path):
        match part:
            case TickBlock():
                blocks.setdefault(part.finger, []).append(dict(_iter_fields(part, fields)))
                count += len(part.rows)
                if count > POSES_MAX:
                    raise RecordingError(f"{path}: more than {POSES_MAX:,} ticks, the limit for reading")
            case RecordedWorld():
                worlds.append(part.world)
            case Event():
                events.append(part.event)
            case Note():
                notes[part.name] = part.value
            case End():
                end = part
    if not blocks:
        raise RecordingError(f"{path}: {explain_no_tick(end)}")
    fingers = {}
    for finger, parts in blocks.items():
        if missing := [name for name in (*_REQUIRED, *fields) if name not in parts[0]]:
            raise RecordingError(f"{path}: its ticks lack {', '.join(missing)}: not a recording of this program")
        fingers[finger] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Run(_keep_common_ticks(_sort_fingers(fingers, notes)), notes, events, end.cut, _read_body_poses(worlds))


def _read_body_poses(worlds: list[dict[str, Any]]) -> BodyPoses:
    """Return the messages with the same bodies as the first one."""
    if not worlds:
        return NO_BODIES
    names = tuple(body["name"] for body in worlds[0]["bodies"])
    messages = {
        message["tick"]: message for message in worlds if tuple(body["name"] for body in message["bodies"]) == names
    }
    poses = [[body["position"] + body["orientation"] for body in messages[tick]["bodies"]] for tick in sorted(messages)]
    return BodyPoses(
        np.array(sorted(messages), np.int64), names, np.array(poses, np.float64).reshape(-1, len(names), 7)
    )


def _iter_fields(ticks: TickBlock, fields: tuple[str, ...]) -> Iterator[tuple[str, Array]]:
    for name in dict.fromkeys((*_REQUIRED, *fields)):
        column = ticks.column(name)
        if column is not None:
            yield name, column


def _sort_fingers(fingers: dict[str, dict[str, Array]], notes: dict[str, Any]) -> dict[str, dict[str, Array]]:
    described = notes.get("fingers")
    names = [entry.get("name") for entry in described if isinstance(entry, dict)] if isinstance(described, list) else []
    by_order = sorted(fingers, key=lambda name: names.index(name) if name in names else len(names))
    return {name: fingers[name] for name in by_order}


def _keep_common_ticks(fingers: dict[str, dict[str, Array]]) -> dict[str, dict[str, Array]]:
    common = np.unique(next(iter(fingers.values()))["tick"])
    for fields in fingers.values():
        common = np.intersect1d(common, fields["tick"])
    result = {}
    for finger, fields in fingers.items():
        _, rows = np.unique(fields["tick"], return_index=True)
        rows = rows[np.isin(fields["tick"][rows], common)]
        result[finger] = {name: column[rows] for name, column in fields.items()}
    return result
