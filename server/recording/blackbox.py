"""Black box: the last ten seconds of a daemon in memory, written to a file after a fault."""

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

from softfinger.config.arrays import Array
from softfinger.config.files import check_owner, find_home_folder
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.recording.writer import RecordingFile, round_integer_fields
from softfinger.server.wire.events import RecordEvents, read_clock_s

HISTORY_S: Final = 10.0
"""Duration of the stored ticks, events and log lines."""
FILES_MAX: Final = 20
BYTES_MAX: Final = 256 << 20
"""Maximum size of the folder; the oldest files are deleted. Ten seconds of one finger at 1 kHz take 2 MB."""
EVENTS_MAX: Final = 4096
LINES_MAX: Final = 2000
TEXT_MAX: Final = 4000
"""Maximum length of a log line, enough for a traceback."""
BLOCK_ROWS: Final = 1024
"""Ticks encoded per block, so that other threads can run between blocks."""
SUFFIX: Final = ".mcap"
PART_SUFFIX: Final = ".part"


def find_folder() -> Path | None:
    """Return the folder of the files, which need not exist; None for a user without a home folder.

    It is $SOFTFINGER_BLACKBOX_DIR, or a folder in the user's state folder (XDG).
    """
    configured = os.environ.get("SOFTFINGER_BLACKBOX_DIR")
    if configured:
        return Path(configured).absolute()
    state, home = os.environ.get("XDG_STATE_HOME", ""), find_home_folder()
    if not state.startswith("/") and home is None:
        return None
    return Path(state if state.startswith("/") else f"{home}/.local/state") / "softfinger" / "blackbox"


def list_files(directory: Path) -> list[Path]:
    """Return the files of a folder, oldest first; empty if the folder does not exist."""
    timed_paths = []
    for path in directory.glob(f"*{SUFFIX}"):
        with contextlib.suppress(OSError):  # deleted by another daemon, or a link to a file that is gone
            timed_paths.append((path.stat().st_mtime, path))
    return [path for _, path in sorted(timed_paths)]


class LogLine(NamedTuple):
    """Line of the log: time (s), level of `logging`, name of the logger, text."""

    time: float
    level: int
    name: str
    text: str


class LogBuffer(logging.Handler):
    """Log handler that stores the latest lines; thread-safe."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: deque[LogLine] = deque(maxlen=LINES_MAX)
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        at_s = read_clock_s() - (time.time() - record.created)
        self._lines.append(LogLine(at_s, record.levelno, record.name, self.format(record)[:TEXT_MAX]))

    def lines(self, since_s: float) -> list[LogLine]:
        """Return the lines since a time (s)."""
        return [line for line in list(self._lines) if line.time >= since_s]


class BlackBox:
    """Ring buffer of a run's latest ticks and events; `take` and `event` never wait for a disk, `write` does.

    Parameters
    ----------
    fingers
        Names of several fingers; one empty name for a single finger.
    guards
        Names of the guard's bits.
    rate_hz
        Rate of the ticks, which determines the size of the buffer.
    """

    def __init__(self, fingers: Sequence[str], guards: Sequence[str], rate_hz: float) -> None:
        self._fingers, self._guards = list(fingers), tuple(guards)
        self._rows = np.zeros((max(1, round(HISTORY_S * rate_hz)), len(self._fingers) * RECORD_SIZE))
        self._next = self._count = 0
        self._lock = threading.Lock()
        """Locked while ticks are copied, about a millisecond."""
        self._events: deque[Mapping[str, Any]] = deque(maxlen=EVENTS_MAX)
        self.log: Final = LogBuffer()

    def take(self, records: Array) -> None:
        """Copy records (n, fingers x RECORD_SIZE) into the buffer."""
        with self._lock:
            for first in range(0, len(records), len(self._rows)):
                block = records[first : first + len(self._rows)]
                until_wrap = min(len(block), len(self._rows) - self._next)
                self._rows[self._next : self._next + until_wrap] = block[:until_wrap]
                self._rows[: len(block) - until_wrap] = block[until_wrap:]
                self._next = (self._next + len(block)) % len(self._rows)
                self._count = min(self._count + len(block), len(self._rows))

    def event(self, event: Mapping[str, Any]) -> None:
        """Store an event, a map as on the wire, that does not follow from the ticks; thread-safe."""
        since = read_clock_s() - HISTORY_S
        with self._lock:
            while self._events and self._events[0]["timestamp"] < since:
                self._events.popleft()
            self._events.append(event)

    def write(self, path: Path, about: Mapping[str, Any]) -> None:
        """Write the stored data to a new file, which appears only when it is complete.

        Parameters
        ----------
        about
            Tables of metadata (`RecordingFile`).

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        with self._lock:
            order = (np.arange(self._next - self._count, self._next)) % len(self._rows)
            rows = self._rows[order].reshape(self._count, len(self._fingers), RECORD_SIZE)
        part = path.with_suffix(PART_SUFFIX)
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            with open(descriptor, "wb", buffering=0) as file:  # also closed if the disk accepts only a part
                recording = RecordingFile(file, self._fingers, about)
                for event in self._write_ticks(recording, rows):
                    recording.event(event)
                since = read_clock_s() - HISTORY_S
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

    def _write_ticks(self, recording: RecordingFile, rows: Array) -> Iterator[Mapping[str, Any]]:
        for index, finger in enumerate(self._fingers):
            event_detector = RecordEvents(self._guards, finger, index == 0)
            for first in range(0, len(rows), BLOCK_ROWS):
                block = round_integer_fields(rows[first : first + BLOCK_ROWS, index].copy())
                recording.ticks(block, finger)
                yield from event_detector.observe(block)


def prepare_folder(directory: Path) -> None:
    """Create the folder for this user only, and delete its oldest files to make room for one more.

    Raises
    ------
    OSError
        If the folder cannot be created.
    ConfigError
        If other users may write to it.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_owner(directory, directory.stat(), "could select the file that this program replaces")
    files_left, bytes_left = FILES_MAX - 1, BYTES_MAX
    for path in reversed(list_files(directory)):
        with contextlib.suppress(OSError):  # another daemon may delete files, too
            bytes_left -= path.stat().st_size
            if files_left <= 0 or bytes_left < 0:
                path.unlink()
        files_left -= 1


def format_file_name(fault: str, number: int) -> str:
    """Return a file name from the time (UTC), the process, the number of its file, and the fault."""
    fault_text = "".join(letter if letter.isalnum() else "-" for letter in fault)
    return f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{os.getpid()}-{number}-{fault_text}{SUFFIX}"
