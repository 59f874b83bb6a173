"""The last ten seconds of a daemon, kept in memory, and written to a file when something goes wrong."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.files import check_owner, home_folder
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.recording.writer import RecordingFile, with_whole_numbers
from softfinger.server.wire.events import RecordEvents
from softfinger.server.wire.stamps import now_s

Array = NDArray[np.float64]

KEPT_S: Final = 10.0
"""What is kept of ticks, events and the log."""
FILES_MAX: Final = 20
BYTES_MAX: Final = 256 << 20
"""Of the folder: the oldest files make room. Ten seconds of a finger at 1 kHz take 2 MB."""
EVENTS_MAX: Final = 4096
LINES_MAX: Final = 2000
TEXT_MAX: Final = 4000
"""Characters of a line of the log: a traceback."""
BLOCK_ROWS: Final = 1024
"""Ticks encoded at a time: other threads have their turn."""
ENDING: Final = ".mcap"
PART: Final = ".part"


def folder() -> Path | None:
    """Return the folder of the files, which need not exist: $SOFTFINGER_BLACKBOX_DIR, or one in the user's state folder
    (XDG). None for a user without a home folder."""
    named = os.environ.get("SOFTFINGER_BLACKBOX_DIR")
    if named:
        return Path(named).absolute()
    state, home = os.environ.get("XDG_STATE_HOME", ""), home_folder()
    if not state.startswith("/") and home is None:
        return None
    return Path(state if state.startswith("/") else f"{home}/.local/state") / "softfinger" / "blackbox"


def files(place: Path) -> list[Path]:
    """The files of a folder, oldest first; none where there is no folder."""
    with contextlib.suppress(OSError):
        found = [(path.stat().st_mtime, path) for path in place.glob(f"*{ENDING}")]
        return [path for _, path in sorted(found)]
    return []


class Line(NamedTuple):
    """A line of the log: time s, number of its level as logging has it, who said it, what."""

    time: float
    level: int
    name: str
    text: str


class Log(logging.Handler):
    """Keeps the newest lines of the log; from any thread."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: deque[Line] = deque(maxlen=LINES_MAX)
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        at_s = now_s() - (time.time() - record.created)
        self._lines.append(Line(at_s, record.levelno, record.name, self.format(record)[:TEXT_MAX]))

    def lines(self, since_s: float) -> list[Line]:
        """Those from a time on."""
        return [line for line in list(self._lines) if line.time >= since_s]


class BlackBox:
    """What is kept of a run: `take` and `event` never wait for a disk, `write` does.

    fingers  names of several fingers, one empty name for a single one
    guards   names of the guard's bits
    rate_hz  of ticks: how many are kept
    """

    def __init__(self, fingers: Sequence[str], guards: Sequence[str], rate_hz: float) -> None:
        self._fingers, self._guards = list(fingers), tuple(guards)
        self._rows = np.zeros((max(1, round(KEPT_S * rate_hz)), len(self._fingers) * RECORD_SIZE))
        self._next = self._count = 0
        self._lock = threading.Lock()
        """Held for as long as ticks are copied, a millisecond."""
        self._events: deque[Mapping[str, Any]] = deque(maxlen=EVENTS_MAX)
        self.log: Final = Log()

    def take(self, records: Array) -> None:
        """Keep records (n, fingers x RECORD_SIZE), which are copied."""
        with self._lock:
            for first in range(0, len(records), len(self._rows)):
                some = records[first : first + len(self._rows)]
                ahead = min(len(some), len(self._rows) - self._next)
                self._rows[self._next : self._next + ahead] = some[:ahead]
                self._rows[: len(some) - ahead] = some[ahead:]
                self._next = (self._next + len(some)) % len(self._rows)
                self._count = min(self._count + len(some), len(self._rows))

    def event(self, event: Mapping[str, Any]) -> None:
        """Keep an event, a map as the wire has it, that does not follow from ticks; from any thread."""
        since = now_s() - KEPT_S
        with self._lock:
            while self._events and self._events[0]["timestamp"] < since:
                self._events.popleft()
            self._events.append(event)

    def write(self, path: Path, about: Mapping[str, Any]) -> None:
        """Write all that is kept to a new file, whole or not at all. OSError where that fails.

        about  tables of metadata (`RecordingFile`)
        """
        with self._lock:
            order = (np.arange(self._next - self._count, self._next)) % len(self._rows)
            rows = self._rows[order].reshape(self._count, len(self._fingers), RECORD_SIZE)
        part = path.with_suffix(PART)
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            with open(descriptor, "wb", buffering=0) as file:  # closed, too, where the disk takes a part
                recording = RecordingFile(file, self._fingers, about)
                for event in self._put_ticks(recording, rows):
                    recording.event(event)
                since = now_s() - KEPT_S
                for event in list(self._events):
                    if event["timestamp"] >= since:
                        recording.event(event)
                for line in self.log.lines(since):
                    recording.log(*line)
                recording.close()
            os.replace(part, path)
        finally:
            with contextlib.suppress(FileNotFoundError):
                part.unlink()

    def _put_ticks(self, recording: RecordingFile, rows: Array) -> Iterator[Mapping[str, Any]]:
        """Write ticks; the events that follow from them."""
        for place, finger in enumerate(self._fingers):
            told = RecordEvents(self._guards, finger, place == 0)
            for first in range(0, len(rows), BLOCK_ROWS):
                some = with_whole_numbers(rows[first : first + BLOCK_ROWS, place].copy())
                recording.ticks(some, finger)
                yield from told.observe(some)


def make_room(place: Path) -> None:
    """Have the folder, which is this user's alone, with room for one more file: the oldest ones go. OSError, or
    ConfigError where others may write to it."""
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_owner(place, place.stat(), "could say what a file of ours replaces")
    kept, left = FILES_MAX - 1, BYTES_MAX
    for path in reversed(files(place)):
        with contextlib.suppress(OSError):  # another daemon makes room, too
            left -= path.stat().st_size
            if kept <= 0 or left < 0:
                path.unlink()
        kept -= 1


def name_of(fault: str, number: int) -> str:
    """A file's name, by the time (UTC), the process, which of its files it is, and the fault."""
    said = "".join(letter if letter.isalnum() else "-" for letter in fault)
    return f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{os.getpid()}-{number}-{said}{ENDING}"
