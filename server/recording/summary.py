"""Summary of a recording, computed in one pass and bounded memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import RecordingError
from softfinger.drivers.poses import find_recording
from softfinger.proxy.record import MODE_NAMES
from softfinger.server.recording.contents import read_recording
from softfinger.server.recording.reader import End, Event, Note, TickBlock, explain_no_tick
from softfinger.server.recording.recorder import END_TABLE

_COPIED_TABLES = ("scene_name", "rate_hz", "every", "versions", "machine", "settings", "device", "scene", "rig", "lost")


class _Finger:
    """Sums over the ticks of one finger."""

    def __init__(self) -> None:
        self.ticks = self.gaps = self.missing = 0
        self.first = self.last = -1
        self.start_s = self.end_s = 0.0
        self.longest = 0
        self.modes: Counter[int] = Counter()
        self.peaks: dict[str, float] = {}
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, ticks: TickBlock) -> None:
        numbers, stamps = ticks.column("tick"), ticks.column("timestamp")
        if numbers is None or stamps is None:
            raise RecordingError("its ticks have no tick, or no timestamp: not a recording of this program")
        if not self.ticks:
            self.first, self.start_s = int(numbers[0]), float(stamps[0])
        steps = np.diff(numbers, prepend=self.last if self.ticks else numbers[0] - 1).astype(int)
        self.add_gaps(steps[steps > 1] - 1)
        self.ticks, self.last, self.end_s = self.ticks + len(numbers), int(numbers[-1]), float(stamps[-1])
        modes = ticks.column("contact.mode")
        if modes is not None:
            self.modes.update(modes.astype(int).tolist())
        positions = ticks.column("probe.position")
        if positions is not None:
            self.low = np.fmin(self.low, np.fmin.reduce(positions))
            self.high = np.fmax(self.high, np.fmax.reduce(positions))
        for name, unit in (("force", "n"), ("torque", "nm"), ("contact.penetration", "m")):
            values = ticks.column(name)
            if values is not None:
                key = f"{name.rpartition('.')[2]}_max_{unit}"
                with np.errstate(over="ignore"):
                    size = np.abs(values) if values.ndim == 1 else np.linalg.norm(values, axis=1)
                self.peaks[key] = max(self.peaks.get(key, 0.0), float(np.nanmax(size, initial=0.0)))

    def add_gaps(self, gaps: NDArray[np.int64]) -> None:
        """Count gaps, given by their numbers of ticks."""
        self.gaps, self.missing = self.gaps + len(gaps), self.missing + int(gaps.sum())
        self.longest = max(self.longest, int(gaps.max(initial=0)))

    def to_dict(self) -> dict[str, Any]:
        modes = {name: self.modes[number] for number, name in enumerate(MODE_NAMES)} if self.modes else {}
        extent = {"position_min_m": self.low.tolist(), "position_max_m": self.high.tolist()}
        return {"ticks": self.ticks, "modes": modes} | self.peaks | (extent if np.isfinite(self.low).all() else {})


def summarize(recording: str | Path) -> dict[str, Any]:
    """Return the summary of a file or a shipped recording, which `softfinger info --json` prints.

    missing         ticks that the file lacks, in `gaps` gaps, also at the ends of a damaged file
    dropped         ticks not written because the disk was too slow, if the file has a regular end
    events_dropped  events not written for the same reason
    lost            ticks that did not arrive over the wire

    Raises
    ------
    RecordingError
        If the file is not a recording of this program.
    """
    path = find_recording(recording)
    fingers: dict[str, _Finger] = {}
    notes: dict[str, Any] = {}
    events: Counter[str] = Counter()
    marks: list[dict[str, Any]] = []
    end = End([], "")
    for part in read_recording(path):
        match part:
            case TickBlock():
                try:
                    fingers.setdefault(part.finger, _Finger()).add(part)
                except RecordingError as error:
                    raise RecordingError(f"{path}: {error}") from error
            case Note():
                notes[part.name] = part.value
            case Event():
                events[f"{part.event['kind']} {part.event['name']}"] += 1
                if part.event["kind"] == "mark":
                    marks.append({key: part.event[key] for key in ("tick", "label")})
            case End():
                end = part
    if not fingers:
        raise RecordingError(f"{path}: {explain_no_tick(end)}")
    first_finger = next(iter(fingers.values()))
    every = notes.get("every") if isinstance(notes.get("every"), int) else 1
    end_table = (notes.get(END_TABLE) if isinstance(notes.get(END_TABLE), dict) else None) or {}
    is_thinned = every != 1
    first_finger.add_gaps(np.array([count for count in end.unread.get(next(iter(fingers)), ()) if count]))
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "whole": not end.cut,
        "cut": end.cut,
        "duration_s": first_finger.end_s - first_finger.start_s,
        "first_tick": first_finger.first,
        "last_tick": first_finger.last,
        "ticks": first_finger.ticks,
        "gaps": 0 if is_thinned else first_finger.gaps,
        "missing": 0 if is_thinned else first_finger.missing,
        "longest_gap": 0 if is_thinned else first_finger.longest,
        "dropped": end_table.get("dropped"),
        "events_dropped": end_table.get("events_dropped"),
        "fingers": {name: finger.to_dict() for name, finger in fingers.items()},
        "events": dict(events),
        "marks": marks,
        "topics": [topic._asdict() for topic in end.topics],
    } | {key: notes.get(key) for key in _COPIED_TABLES}


def format_extent(low_m: Iterable[float], high_m: Iterable[float]) -> str:
    """Return the range of positions (3,), m, as text in mm."""
    axes = (f"{axis} {1e3 * low:.4g} to {1e3 * high:.4g}" for axis, low, high in zip("xyz", low_m, high_m, strict=True))
    return f"{', '.join(axes)} mm"
