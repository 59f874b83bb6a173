"""Thread that passes ticks on: it sleeps until the servo has a record, and wakes and copies without the interpreter.

It is the only reader of the servo's ring. It copies every tick into a ring buffer in shared memory for all readers on
this machine, and wakes them, so the servo does not have to. It wakes the publisher for each tick, and readers in this
process only after an event or at intervals.
"""

from __future__ import annotations

import logging
import os
import threading
import weakref
from contextlib import ExitStack
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.eventfd import poll_eventfd, reset_eventfd, wait_for_eventfd, wake_eventfd
from softfinger.server.loop.rings import Feed, Rings, make_ring, take
from softfinger.server.progress import report_compilation
from softfinger.server.wire.native.broadcast import Broadcast, make_read_position, read_rows, write_row
from softfinger.server.wire.native.memory import make_memory, release, remove, wake_readers

log: Final = logging.getLogger(__name__)

ROWS: Final = 64
"""Largest number of ticks read from the ring at a time."""

CAPACITY_TICKS: Final = 8192
"""Number of ticks by which a reader may be late: 8 s at 1 kHz, 1 s at 8 kHz."""

WAKE_INTERVAL_MS: Final = 10
"""Readers in this process are woken at once after an event, and otherwise at this interval: each wake-up of Python
costs as much as passing on a hundred ticks."""
_WAKE_INTERVAL_S: Final = WAKE_INTERVAL_MS / 1000.0

JOIN_S: Final = 1.0

# Indices in `RelayState.words`.
_CALLS: Final = 0  # number of requests to return to Python
_TICK: Final = 1  # latest tick passed on


class RelayState(NamedTuple):
    """Memory of the relay.

    readers       ring buffer for all readers on this machine
    publisher_fd  eventfd that wakes the publisher
    bell_fd       eventfd that wakes readers in this process
    words         number of calls, and latest tick
    rows          (ROWS, width) rows from the servo's ring
    last_values   (fingers + 1,) guard bits of each finger in the last tick, and missed deadlines
    woken_s       (1,) time of the tick at which readers in this process were last woken
    """

    readers: Broadcast
    publisher_fd: int
    bell_fd: int
    words: NDArray[np.int64]
    rows: NDArray[np.float64]
    last_values: NDArray[np.float64]
    woken_s: NDArray[np.float64]


@entry
def serve(state: RelayState, feed: Feed, completed: int, calls: int, file: NDArray[np.int64]) -> bool:
    """Copy ticks to the readers until the feed is complete (returns True) or Python requests a return (False).

    completed  number of completed rings of the servo when this ring was started
    calls      number of requests that Python has handled
    file       (1,)  scratch memory
    """
    woken = True
    while True:
        is_complete = load_acquire(feed.completed_rings, 0) != completed  # read before the ring, as is `called`
        called = load_acquire(state.words, _CALLS) != calls
        count = take(feed.ring, state.rows)
        while count > 0:
            woken = pass_on(state, state.rows, count)
            count = take(feed.ring, state.rows)
        if is_complete or called:
            return bool(is_complete)
        if poll_eventfd(feed.wake_fd, -1 if woken else WAKE_INTERVAL_MS, file):
            reset_eventfd(feed.wake_fd, file)
        elif not woken:
            woken = True
            wake_eventfd(state.bell_fd)


@jit
def pass_on(state: RelayState, rows: NDArray[np.float64], count: int) -> bool:
    """Pass on `count` ticks, rows (n, width); return whether readers in this process were woken."""
    woken = False
    for r in range(count):
        write_row(state.readers, rows, r)
        woken = _has_event(state, rows, r) or woken
    tick = rows[count - 1, AT.tick]
    store_release(state.words, _TICK, int(tick) if tick == tick else -1)
    wake_eventfd(state.publisher_fd)
    wake_readers(state.readers)
    if woken:
        wake_eventfd(state.bell_fd)
    return woken


@jit
def _has_event(state: RelayState, rows: NDArray[np.float64], row: int) -> bool:
    """Return whether to wake readers in this process: the tick has an event, or WAKE_INTERVAL_MS have passed."""
    since = rows[row, AT.timestamp] - state.woken_s[0]
    has_event = not 0.0 <= since < _WAKE_INTERVAL_S
    fingers = len(state.last_values) - 1
    for finger in range(fingers):
        column = finger * RECORD_SIZE
        guard = rows[row, column + AT.servo_guard]
        has_event = has_event or rows[row, column + AT.contact_cause] != 0.0 or guard != state.last_values[finger]
        state.last_values[finger] = guard
    has_event = has_event or rows[row, AT.servo_missed] != state.last_values[fingers]
    state.last_values[fingers] = rows[row, AT.servo_missed]
    if has_event:
        state.woken_s[0] = rows[row, AT.timestamp]
    return bool(has_event)


class Tap:
    """Reader for one thread of this process, which must not fall behind by more than CAPACITY_TICKS ticks."""

    def __init__(self, readers: Broadcast, bell_fd: int, ended: threading.Event, failed: threading.Event) -> None:
        self._readers, self._ended, self._failed = readers, ended, failed
        self._ring_fd, self._bell_fd = bell_fd, os.dup(bell_fd)  # a thread that reads late outlives the relay
        self.close: Final = weakref.finalize(self, os.close, self._bell_fd)
        """Called by the reader when it has finished."""
        self._position = make_read_position(readers)
        read_rows.compile(_declare_types(readers, self._position, np.empty((1, readers.slots.shape[1]))))  # type: ignore[attr-defined]

    def wait(self) -> None:
        """Sleep until there may be records, or until the end."""
        wait_for_eventfd(self._bell_fd)

    def wake(self) -> None:
        """Wake a thread in `wait`, from any thread, as long as the relay exists."""
        os.eventfd_write(self._ring_fd, 1)

    def take(self, out: NDArray[np.float64]) -> int:
        """Copy the oldest records to `out` (n, width); return their number."""
        return read_rows(self._readers, self._position, out)

    @property
    def ended(self) -> bool:
        """True if the available records are the last ones."""
        return self._ended.is_set()

    @property
    def failed(self) -> bool:
        """True if the thread of the relay has failed."""
        return self._failed.is_set()

    @property
    def lost(self) -> int:
        """Ticks that were overwritten before they were read."""
        return int(self._position.lost[0])


class Relay:
    """Relay thread, and the memory in which it passes on the records of `fingers` fingers.

    memory  memory with every tick
    bell    eventfd that wakes the publisher
    """

    def __init__(self, fingers: int) -> None:
        width = fingers * RECORD_SIZE
        with ExitStack() as undo:
            self.memory: Final = make_memory(CAPACITY_TICKS, width)
            undo.callback(release, self.memory)
            self._files: Final = undo.enter_context(ExitStack())
            self.bell, bell, idle = self._open_eventfd(), self._open_eventfd(), self._open_eventfd()
            self._state: Final = RelayState(
                self.memory.broadcast,
                self.bell,
                bell,
                np.array([0, -1, 0, 0, 0, 0, 0, 0]),
                np.empty((ROWS, width)),
                np.zeros(fingers + 1),
                np.full(1, -np.inf),
            )
            self._file = np.zeros(1, np.int64)
            self._idle_feed: Final = Feed(make_ring(1, width), np.zeros(8, np.int64), idle)
            """Ring on which the thread sleeps while there is no servo."""
            self._asleep_on = self._idle_feed.wake_fd
            self._source: Rings | None = None
            self._finished, self._failed, self._closing = (threading.Event() for _ in range(3))
            self.tap: Final = Tap(self._state.readers, bell, self._finished, self._failed)
            self._compile()
            self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
            self._thread.start()
            undo.pop_all()

    def _open_eventfd(self) -> int:
        fd = os.eventfd(0)
        self._files.callback(os.close, fd)
        return fd

    def _compile(self) -> None:
        kernels: list[tuple[Any, tuple[Any, ...]]] = [
            (serve, (self._state, self._idle_feed, 0, 0, self._file)),
            (wake_readers, (self._state.readers,)),
        ]
        with report_compilation("kernels of the relay"):
            for kernel, arguments in kernels:
                kernel.compile(_declare_types(*arguments))

    @property
    def rows(self) -> int:
        return int(self._state.readers.head[0])

    @property
    def tick(self) -> int:
        """Latest tick passed on; -1 before the first."""
        return int(self._state.words[_TICK])

    @property
    def native_id(self) -> int | None:
        return self._thread.native_id

    def attach(self, source: Rings) -> None:
        """Pass on the records of a servo from now on, until it ends. Call it once."""
        self._source = source
        self._call()

    def send(self, rows: NDArray[np.float64]) -> None:
        """Pass on ticks without a servo, shape (n, width). Not while a servo is attached."""
        if len(rows):
            pass_on_rows(self._state, np.ascontiguousarray(rows))

    def close(self) -> None:
        """End the thread. Call it once."""
        self._closing.set()
        self._call()
        self._thread.join(JOIN_S)
        remove(self.memory)
        if not self._thread.is_alive():
            self._files.close()

    def _call(self) -> None:
        """Make the thread return to Python. Only one thread at a time may call this."""
        self._state.words[_CALLS] += 1
        os.eventfd_write(self._asleep_on, 1)

    def _run(self) -> None:
        feeds, feed, completed = None, self._idle_feed, 0
        try:
            while True:
                calls = int(self._state.words[_CALLS])
                if self._closing.is_set():
                    return
                if feeds is None and self._source is not None:
                    feeds = self._source.iter_feeds()
                    feed = next(feeds)
                self._asleep_on = feed.wake_fd
                if serve(self._state, feed, completed, calls, self._file) and feeds is not None:
                    completed, feed = completed + 1, next(feeds, self._idle_feed)
                    if feed is self._idle_feed:
                        completed, self._asleep_on = 0, feed.wake_fd  # first: at its end the servo closes its eventfd
                        self._end()
        except Exception:
            self._failed.set()
            self._asleep_on = self._idle_feed.wake_fd
            log.exception("telemetry: the thread that forwards ticks failed")
            self._end()

    def _end(self) -> None:
        self._finished.set()
        self.tap.wake()


@entry
def pass_on_rows(state: RelayState, rows: NDArray[np.float64]) -> None:
    """Call `pass_on` for rows (n, width) from Python."""
    pass_on(state, rows, len(rows))


def _declare_types(*arguments: Any) -> tuple[Any, ...]:
    return tuple(numba.typeof(argument) for argument in arguments)
