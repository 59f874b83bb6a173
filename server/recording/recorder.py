"""A recording beside a running loop: whoever brings ticks never waits, a thread writes them.

What the disk does not take in time is counted, told in the file, and left out.
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
from numpy.typing import NDArray

from softfinger.proxy.record import AT
from softfinger.server.recording.writer import RecordingFile, with_whole_numbers
from softfinger.server.wire.events import RecordEvents

Array = NDArray[np.float64]

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 0.05
"""How often what has come goes to the system: a kill costs this, and what was on its way."""
QUEUE_ROWS: Final = 65536
"""Ticks that wait for the disk at most: 65 s at 1 kHz, 8 s at 8 kHz, 45 MB."""
QUEUE_EVENTS: Final = 4096
"""Events that wait at most; beyond, what comes is left out."""
BLOCK_ROWS: Final = 1024
"""Ticks encoded at a time, in less than the interpreter's switch interval of 5 ms."""
END: Final = "end"
"""Table of metadata that a recording that ended in order has: how many ticks it has, and how many it lacks."""


class Recorded(NamedTuple):
    """What became of a recording: ticks of the first finger written, rows of any left out since the
    disk was too slow, bytes; `error` is empty
    unless it ended early; `whole` when all is written and closed; events left out, for the same reason; the longest
    that a write took."""

    ticks: int
    dropped: int
    bytes: int
    error: str
    whole: bool
    events_dropped: int
    worst_write_s: float


class Bodies(dict[str, Any]):
    """A message of `world`, which waits among the events."""


class Recorder:
    """Writes to an unbuffered file that is open already, from a thread of its own, until `stop`.

    about    as of `RecordingFile`
    trouble  called from the thread with a sentence when ticks were left out, and when the recording ends early: then
             with True behind it
    guards   names of the guard's bits, where events are to be told from the ticks; None where they come by `event`
    """

    def __init__(
        self,
        file: IO[bytes],
        fingers: Sequence[str],
        about: Mapping[str, Any],
        trouble: Callable[[str, bool], None],
        guards: Sequence[str] | None = None,
    ) -> None:
        self._file, self._fingers, self._about, self._trouble = file, list(fingers), about, trouble
        self._told = [
            RecordEvents(guards, finger, place == 0) if guards is not None else None
            for place, finger in enumerate(self._fingers)
        ]
        self._queue: deque[tuple[int, Array]] = deque()
        self._events: deque[Mapping[str, Any] | tuple[str, Any]] = deque()
        self._counting = threading.Lock()
        self._events_dropped = self._told_events_dropped = 0
        self._worst_write_s = 0.0
        self._came = self._gone = 0  # rows, each counted by one thread
        self._ticks = self._dropped = self._bytes = 0
        self._newest, self._written_to = -1, -1
        self._told_dropped = 0
        self._dropping, self._dropped_from = False, -1
        self._error = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def take(self, records: Array, finger: int = 0) -> None:
        """Records (n, RECORD_SIZE) of a finger, by its place; copied, never waits. From one thread."""
        if self._error or self._closing.is_set():
            return
        if self._came - self._gone + len(records) > QUEUE_ROWS * len(self._fingers):
            if not self._dropping:
                self._dropping, self._dropped_from = True, int(records[0, AT.tick])
            self._dropped += len(records)
            return
        self._dropping = False
        self._came += len(records)
        self._queue.append((finger, records.copy()))

    def event(self, event: Mapping[str, Any]) -> None:
        """An event's map, as the wire has it; never waits. From any thread."""
        if self._error:
            return
        with self._counting:
            if len(self._events) < QUEUE_EVENTS:
                self._events.append(event)
            else:
                self._events_dropped += 1

    def world(self, world: Mapping[str, Any]) -> None:
        """A message of `world`, a map as the wire has it; never waits. From any thread."""
        self.event(Bodies(world))

    def note(self, name: str, value: Any) -> None:
        """A table of metadata; never waits. From any thread."""
        self._events.append((name, value))

    @property
    def recorded(self) -> Recorded:
        """What has become of it so far."""
        ended = not self._thread.is_alive()
        return Recorded(
            self._ticks, self._dropped, self._bytes, self._error, ended and not self._error,
            self._events_dropped, self._worst_write_s,
        )  # fmt: skip

    @property
    def written_to(self) -> int:
        """The last tick that the system has taken, -1 for none."""
        return self._written_to

    @property
    def failed(self) -> bool:
        """Whether the file takes no more."""
        return bool(self._error)

    def stop(self, timeout_s: float) -> Recorded:
        """End in order, and wait for the disk at most so long; it goes on writing after that. Any number of times."""
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
                recording.note(END, end)
                recording.close()
                self._count(recording)
            except OSError:
                # Back to the last chunk that is whole, so that the file ends with one.
                with contextlib.suppress(OSError, ValueError):
                    os.ftruncate(self._file.fileno(), recording.mcap.size)
                self._count(recording)
                raise
        except Exception as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else f"{error}"
            self._error = reason or type(error).__name__
            if not isinstance(error, OSError):
                log.exception("recording failed")
            self._queue.clear()
            self._trouble(f"the recording ends after {self._ticks} ticks: {self._error}", True)
        finally:
            with contextlib.suppress(OSError):
                self._file.close()

    def _count(self, recording: RecordingFile) -> None:
        self._ticks, self._bytes = recording.count(self._fingers[0]), recording.mcap.size
        self._worst_write_s = recording.mcap.worst_write_s

    def _write(self, recording: RecordingFile) -> None:
        """Write all that waits, a batch of each finger at a time."""
        batches: dict[int, list[Array]] = {}
        rows = 0
        for _ in range(len(self._queue)):
            finger, records = self._queue.popleft()
            batches.setdefault(finger, []).append(records)
            rows += len(records)
        for finger, each in batches.items():
            records = with_whole_numbers(np.concatenate(each))
            if finger == len(self._fingers) - 1:  # whose ticks come last
                self._newest = int(records[-1, AT.tick])
            told = self._told[finger]
            for first in range(0, len(records), BLOCK_ROWS):  # some at a time: other threads have their turn
                some = records[first : first + BLOCK_ROWS]
                recording.ticks(some, self._fingers[finger])
                for event in [] if told is None else told.observe(some):
                    recording.event(event)
        for _ in range(len(self._events)):
            event_or_note = self._events.popleft()
            if isinstance(event_or_note, tuple):
                recording.note(*event_or_note)
            elif isinstance(event_or_note, Bodies):
                recording.world(event_or_note)
            else:
                recording.event(event_or_note)
        recording.flush()
        self._count(recording)
        self._written_to = self._newest
        # Behind the write: while the disk takes nothing, there is no room for more.
        self._gone += rows
        dropped = self._dropped
        if count := dropped - self._told_dropped:
            self._told_dropped = dropped
            begun = self._dropped_from
            self._trouble(f"{count} ticks from tick {begun} on are not recorded: the disk was too slow", False)
        events_dropped = self._events_dropped
        if count := events_dropped - self._told_events_dropped:
            self._told_events_dropped = events_dropped
            self._trouble(f"{count} events are not recorded: the disk was too slow", False)
