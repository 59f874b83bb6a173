"""Recorder of a running loop: callers never wait, and a separate thread writes the file.

Data that the disk does not accept in time are dropped and counted in the file.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any, Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.files import FULL_DISK
from softfinger.proxy.record import AT
from softfinger.server.recording.writer import RecordingFile, round_integer_fields
from softfinger.server.wire.events import RecordEvents

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 0.05
"""Period of the writes: a kill loses at most this time, plus the data in transit."""
QUEUE_ROWS: Final = 65536
"""Maximum of ticks that wait for the disk: 65 s at 1 kHz, 8 s at 8 kHz, 45 MB."""
QUEUE_EVENTS: Final = 4096
"""Maximum of waiting events; further ones are dropped."""
BLOCK_ROWS: Final = 1024
"""Ticks encoded per block, in less than the interpreter's switch interval of 5 ms."""
END_TABLE: Final = "end"
"""Table of metadata of a recording with a regular end: number of written and of dropped ticks."""
NEW_RECORDING_REMEDY: Final = "make room on the disk or choose another disk, then start another recording"


class RecorderState(NamedTuple):
    """State of a recording.

    ticks           written ticks of the first finger
    dropped         ticks of all fingers dropped because the disk was too slow
    error           reason of an early end; else empty
    whole           whether everything is written and the file closed
    events_dropped  events dropped because the disk was too slow
    worst_write_s   longest duration of a write
    """

    ticks: int = 0
    dropped: int = 0
    bytes: int = 0
    error: str = ""
    whole: bool = False
    events_dropped: int = 0
    worst_write_s: float = 0.0

    def with_recording(self, other: RecorderState) -> RecorderState:
        """Return the numbers of both recordings together."""
        return self._replace(
            ticks=self.ticks + other.ticks,
            dropped=self.dropped + other.dropped,
            bytes=self.bytes + other.bytes,
            events_dropped=self.events_dropped + other.events_dropped,
            worst_write_s=max(self.worst_write_s, other.worst_write_s),
        )


class Recorder:
    """Writes to an open unbuffered file in a separate thread until `stop`.

    If the disk is full, the file ends with the last complete write; without any message it is removed.

    Parameters
    ----------
    about
        Tables of metadata (`RecordingFile`).
    on_trouble
        Called from the thread with a sentence when ticks were dropped or the recording failed; true: it failed.
    guards
        Names of the guard's bits, to derive events from the ticks; None: all events arrive by `event`.
    """

    def __init__(
        self,
        file: IO[bytes],
        fingers: Sequence[str],
        about: Mapping[str, Any],
        on_trouble: Callable[[str, bool], None],
        guards: Sequence[str] | None = None,
    ) -> None:
        self._file, self._fingers, self._about, self._on_trouble = file, list(fingers), about, on_trouble
        self._event_detectors: dict[str, RecordEvents] = {}
        if guards is not None:
            for finger in fingers:
                self._event_detectors[finger] = RecordEvents(guards, finger, finger == fingers[0])
        self._queue: deque[tuple[str, Array]] = deque()
        self._events: deque[Callable[[RecordingFile], None]] = deque()
        """Writers of an event, a message or a table of metadata."""
        self._events_lock = threading.Lock()
        self._events_dropped = self._reported_events_dropped = 0
        self._worst_write_s = 0.0
        self._queued_rows = self._written_rows = 0  # rows, each counter written by one thread
        self._ticks = self._dropped = self._bytes = 0
        self._last_tick = self.last_written_tick = -1
        """`last_written_tick`: last tick written to the file; -1 before the first."""
        self._reported_dropped = 0
        self._is_dropping, self._dropped_from = False, -1
        self._error, self.is_disk_full = "", False
        self._is_empty = True  # no message is written
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def ticks(self, records: Array, finger: str = "") -> None:
        """Copy records (n, RECORD_SIZE) of a finger to the queue; never waits. From one thread."""
        if self._error or self._closing.is_set():
            return
        if self._queued_rows - self._written_rows + len(records) > QUEUE_ROWS * len(self._fingers):
            if not self._is_dropping:
                self._is_dropping, self._dropped_from = True, int(records[0, AT.tick])
            self._dropped += len(records)
            return
        self._is_dropping = False
        self._queued_rows += len(records)
        self._queue.append((finger, records.copy()))

    def event(self, event: Mapping[str, Any]) -> None:
        """Queue an event, a map as on the wire; never waits. Thread-safe."""
        self._append(lambda recording: recording.event(event))

    def message(self, topic: str, message: Mapping[str, Any]) -> None:
        """Queue a message of a topic of the scene, a map as on the wire; never waits. Thread-safe."""
        self._append(lambda recording: recording.message(topic, message))

    def _append(self, write: Callable[[RecordingFile], None]) -> None:
        if self._error:
            return
        with self._events_lock:
            if len(self._events) < QUEUE_EVENTS:
                self._events.append(write)
            else:
                self._events_dropped += 1

    def note(self, name: str, value: Any) -> None:
        """Queue a table of metadata; never waits. Thread-safe."""
        self._events.append(lambda recording: recording.note(name, value))

    @property
    def recorded(self) -> RecorderState:
        ended = not self._thread.is_alive()
        return RecorderState(
            self._ticks, self._dropped, self._bytes, self._error, ended and not self._error,
            self._events_dropped, self._worst_write_s,
        )  # fmt: skip

    def stop(self, timeout_s: float) -> RecorderState:
        """Finish the recording; after at most `timeout_s`, return while the thread writes. May be called repeatedly."""
        self._closing.set()
        self._thread.join(timeout_s)
        return self.recorded

    def _run(self) -> None:
        try:
            recording = RecordingFile(self._file, self._fingers, self._about)
            try:
                while not self._closing.wait(PERIOD_S):
                    self._write(recording)
                self._write(recording)
                end = {"ticks": self._ticks, "dropped": self._dropped, "events_dropped": self._events_dropped}
                recording.note(END_TABLE, end)
                recording.close()
                self._count(recording)
            except Exception:
                recording.close_early()
                self._count(recording)
                raise
        except Exception as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else f"{error}"
            self.is_disk_full = isinstance(error, OSError) and error.errno in FULL_DISK
            self._error = reason or type(error).__name__
            remedy = f": {NEW_RECORDING_REMEDY}"
            if not isinstance(error, OSError):
                log.exception("recording failed")
                remedy = ""
            self._queue.clear()
            if self._is_empty:
                self._remove_file()
            self._on_trouble(f"the recording ends after {self._ticks} ticks: {self._error}{remedy}", True)
        finally:
            with contextlib.suppress(OSError):
                self._file.close()

    def _count(self, recording: RecordingFile) -> None:
        self._ticks, self._bytes = recording.count(self._fingers[0]), recording.mcap.size
        self._worst_write_s = recording.mcap.worst_write_s
        self._is_empty = not recording.mcap.counts

    def _remove_file(self) -> None:
        if isinstance(self._file.name, str):
            with contextlib.suppress(OSError):
                os.unlink(self._file.name)

    def _write(self, recording: RecordingFile) -> None:
        """Write all queued data, one batch per finger."""
        batches: dict[str, list[Array]] = {}
        rows = 0
        for _ in range(len(self._queue)):
            finger, records = self._queue.popleft()
            batches.setdefault(finger, []).append(records)
            rows += len(records)
        for finger, arrays in batches.items():
            records = round_integer_fields(np.concatenate(arrays))
            if finger == self._fingers[-1]:  # its ticks arrive last
                self._last_tick = int(records[-1, AT.tick])
            detector = self._event_detectors.get(finger)
            for first in range(0, len(records), BLOCK_ROWS):  # in blocks, so that other threads can run
                block = records[first : first + BLOCK_ROWS]
                recording.ticks(block, finger)
                for event in [] if detector is None else detector.observe(block):
                    recording.event(event)
        for _ in range(len(self._events)):
            self._events.popleft()(recording)
        recording.flush()
        self._count(recording)
        self.last_written_tick = self._last_tick
        # After the write: the queue has no room while the disk accepts nothing.
        self._written_rows += rows
        dropped = self._dropped
        if count := dropped - self._reported_dropped:
            self._reported_dropped = dropped
            first_tick = self._dropped_from
            self._on_trouble(f"{count} ticks from tick {first_tick} on were not recorded: the disk was too slow", False)
        events_dropped = self._events_dropped
        if count := events_dropped - self._reported_events_dropped:
            self._reported_events_dropped = events_dropped
            self._on_trouble(f"{count} events were not recorded: the disk was too slow", False)
