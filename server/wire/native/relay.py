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
from collections.abc import Iterator
from typing import Any, Final, NamedTuple, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.shared.bell import wait_for
from softfinger.server.loop.shared.broadcast import Broadcast, make_place, read_rows, write_row
from softfinger.server.loop.shared.ring import Feed, make_ring, take
from softfinger.server.progress import making
from softfinger.server.wire.native.memory import make_memory, remove, ring_readers, wake_readers
from softfinger.server.wire.native.system import ring, silence, sleep_on

log: Final = logging.getLogger(__name__)

ROWS: Final = 64
"""Largest number of ticks read from the ring at a time."""

HANDED_ON: Final = 8192
"""Number of ticks by which a reader may be late: 8 s at 1 kHz, 1 s at 8 kHz."""

BELL_MS: Final = 10
"""Readers in this process are woken at once after an event, and otherwise at this interval: each wake-up of Python
costs as much as passing on a hundred ticks."""
_BELL_S: Final = BELL_MS / 1000.0

JOIN_S: Final = 1.0

# Indices in `Post.words`.
_CALLS: Final = 0  # number of requests to return to Python
_TICK: Final = 1  # latest tick passed on


class Source(Protocol):
    """Source of records: the rings of a servo."""

    def feeds(self) -> Iterator[Feed]:
        """Yield each ring; the next one is requested when the previous one is complete."""


class Post(NamedTuple):
    """Memory of the relay.

    readers       ring buffer for all readers on this machine
    publisher_fd  eventfd that wakes the publisher
    bell_fd       eventfd that wakes readers in this process
    words         number of calls, and latest tick
    rows          (ROWS, width) rows from the servo's ring
    seen          (fingers + 1,) guard bits of each finger in the last tick, and missed deadlines
    belled_s      (1,) time of the tick at which readers in this process were last woken
    """

    readers: Broadcast
    publisher_fd: int
    bell_fd: int
    words: NDArray[np.int64]
    rows: NDArray[np.float64]
    seen: NDArray[np.float64]
    belled_s: NDArray[np.float64]


@entry
def serve(post: Post, feed: Feed, turn: int, call: int, file: NDArray[np.int64]) -> bool:
    """Pass on all ticks; return True once the feed is no longer at turn `turn` and its ring is empty.

    Returns False once there have been more calls than `call`. `file` (1,) is scratch.
    """
    told = True
    while True:
        turned = load_acquire(feed.turns, 0) != turn  # before the ring is emptied, as is `called`
        called = load_acquire(post.words, _CALLS) != call
        count = take(feed.ring, post.rows)
        while count > 0:
            told = hand_on(post, post.rows, count)
            count = take(feed.ring, post.rows)
        if turned or called:
            return bool(turned)
        if sleep_on(feed.wake_fd, -1 if told else BELL_MS, file):
            silence(feed.wake_fd, file)
        elif not told:
            told = True
            ring(post.bell_fd)


@jit
def hand_on(post: Post, rows: NDArray[np.float64], count: int) -> bool:
    """Pass on `count` ticks, rows (n, width); return whether readers in this process were woken."""
    told = False
    for r in range(count):
        write_row(post.readers, rows, r)
        told = _matters(post, rows, r) or told
    tick = rows[count - 1, AT.tick]
    store_release(post.words, _TICK, int(tick) if tick == tick else -1)
    ring(post.publisher_fd)
    wake_readers(post.readers)
    if told:
        ring(post.bell_fd)
    return told


@jit
def _matters(post: Post, rows: NDArray[np.float64], row: int) -> bool:
    """Return whether to wake readers in this process: the tick has an event, or they were not woken for BELL_MS."""
    since = rows[row, AT.timestamp] - post.belled_s[0]
    matters = not 0.0 <= since < _BELL_S
    fingers = len(post.seen) - 1
    for finger in range(fingers):
        column = finger * RECORD_SIZE
        guard = rows[row, column + AT.servo_guard]
        matters = matters or rows[row, column + AT.contact_cause] != 0.0 or guard != post.seen[finger]
        post.seen[finger] = guard
    matters = matters or rows[row, AT.servo_missed] != post.seen[fingers]
    post.seen[fingers] = rows[row, AT.servo_missed]
    if matters:
        post.belled_s[0] = rows[row, AT.timestamp]
    return bool(matters)


class Tap:
    """Reader for one thread of this process, which must not fall behind by more than HANDED_ON ticks."""

    def __init__(self, readers: Broadcast, bell_fd: int, ended: threading.Event, failed: threading.Event) -> None:
        self._readers, self._ended, self._failed = readers, ended, failed
        self._ring_fd, self._bell_fd = bell_fd, os.dup(bell_fd)  # a thread that reads late outlives the relay
        self.close: Final = weakref.finalize(self, os.close, self._bell_fd)
        """Called by the reader when it has finished."""
        self._place = make_place(readers)
        read_rows.compile(_types(readers, self._place, np.empty((1, readers.slots.shape[1]))))  # type: ignore[attr-defined]

    def wait(self) -> None:
        """Sleep until there may be records, or until the end."""
        wait_for(self._bell_fd)

    def wake(self) -> None:
        """Wake a thread in `wait`, from any thread, as long as the relay exists."""
        os.eventfd_write(self._ring_fd, 1)

    def take(self, out: NDArray[np.float64]) -> int:
        """Copy the oldest records to `out` (n, width); return their number."""
        return read_rows(self._readers, self._place, out)

    @property
    def ended(self) -> bool:
        """Whether no record will follow the ones that are available now."""
        return self._ended.is_set()

    @property
    def failed(self) -> bool:
        """Whether the thread of the relay has failed."""
        return self._failed.is_set()

    @property
    def lost(self) -> int:
        """Ticks that were overwritten before they were read."""
        return int(self._place.lost[0])


class Relay:
    """Relay thread, and the memory in which it passes on the records of `fingers` fingers."""

    def __init__(self, fingers: int) -> None:
        width = fingers * RECORD_SIZE
        bell, self.bell = os.eventfd(0), os.eventfd(0)
        self._memory = make_memory(HANDED_ON, width)
        self._post: Final = Post(
            self._memory.broadcast,
            self.bell,
            bell,
            np.array([0, -1, 0, 0, 0, 0, 0, 0]),
            np.empty((ROWS, width)),
            np.zeros(fingers + 1),
            np.full(1, -np.inf),
        )
        self._file = np.zeros(1, np.int64)
        self._home: Final = Feed(make_ring(1, width), np.zeros(8, np.int64), os.eventfd(0))
        """Ring on which the thread sleeps while there is no servo."""
        self._asleep_on = self._home.wake_fd
        self._source: Source | None = None
        self._done, self._failed, self._closing = (threading.Event() for _ in range(3))
        self.tap: Final = Tap(self._post.readers, bell, self._done, self._failed)
        self._compile()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def _compile(self) -> None:
        kernels: list[tuple[Any, tuple[Any, ...]]] = [
            (serve, (self._post, self._home, 0, 0, self._file)),
            (ring_readers, (self._post.readers,)),
        ]
        with making("kernels that hand ticks on"):
            for kernel, given in kernels:
                kernel.compile(_types(*given))

    @property
    def memory(self) -> str:
        """Name under which programs of this user find every tick, '' if they cannot."""
        return self._memory.name

    @property
    def file(self) -> int:
        """File of the same memory, opened read-only, for the publisher."""
        return self._memory.reading

    @property
    def rows(self) -> int:
        """Number of ticks passed on."""
        return int(self._post.readers.head[0])

    @property
    def tick(self) -> int:
        """Latest tick passed on; -1 before the first."""
        return int(self._post.words[_TICK])

    @property
    def native_id(self) -> int | None:
        """Native id of the thread."""
        return self._thread.native_id

    def attach(self, source: Source) -> None:
        """Pass on the records of a servo from now on, until it ends. Call it once."""
        self._source = source
        self._call()

    def send(self, rows: NDArray[np.float64]) -> None:
        """Pass on ticks without a servo, shape (n, width). Not while a servo is attached."""
        if len(rows):
            hand_on_given(self._post, np.ascontiguousarray(rows))

    def close(self) -> None:
        """End the thread. Call it once."""
        self._closing.set()
        self._call()
        self._thread.join(JOIN_S)
        remove(self._memory)
        if not self._thread.is_alive():
            for file in (self._home.wake_fd, self._post.bell_fd, self.bell):
                os.close(file)

    def _call(self) -> None:
        """Make the thread return to Python; not from two threads at once."""
        self._post.words[_CALLS] += 1
        os.eventfd_write(self._asleep_on, 1)

    def _run(self) -> None:
        feeds, feed, turn = None, self._home, 0
        try:
            while True:
                call = int(self._post.words[_CALLS])
                if self._closing.is_set():
                    return
                if feeds is None and self._source is not None:
                    feeds = self._source.feeds()
                    feed = next(feeds)
                self._asleep_on = feed.wake_fd
                if serve(self._post, feed, turn, call, self._file) and feeds is not None:
                    turn, feed = turn + 1, next(feeds, self._home)
                    if feed is self._home:
                        turn, self._asleep_on = 0, feed.wake_fd  # first: at its end the servo closes its eventfd
                        self._end()
        except Exception:
            self._failed.set()
            self._asleep_on = self._home.wake_fd
            log.exception("telemetry: the thread that hands ticks on failed")
            self._end()

    def _end(self) -> None:
        self._done.set()
        self.tap.wake()


@entry
def hand_on_given(post: Post, rows: NDArray[np.float64]) -> None:
    """Call `hand_on` for rows (n, width) from Python."""
    hand_on(post, rows, len(rows))


def _types(*arguments: Any) -> tuple[Any, ...]:
    return tuple(numba.typeof(argument) for argument in arguments)
