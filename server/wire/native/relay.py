"""The thread that hands ticks on: it sleeps until the servo has a record, and wakes and copies without the interpreter.

It alone empties the servo's ring. What it took it hands on to everybody on this machine who wants records, by a
broadcast in shared memory: they are woken by it, not by the servo. The publisher is woken for each tick; readers in
this process only where something has happened, or at times.
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
"""Most ticks that are taken from the ring at a time."""

HANDED_ON: Final = 8192
"""Ticks that a reader may fall behind: 8 s at 1 kHz, 1 s at 8 kHz."""

BELL_MS: Final = 10
"""Readers in this process are woken at once where something has happened, and else this often: each wake-up of
Python costs as much as handing on a hundred ticks."""
_BELL_S: Final = BELL_MS / 1000.0

JOIN_S: Final = 1.0

# Words of the post.
_CALLS: Final = 0  # how often the thread was asked back to Python
_TICK: Final = 1  # newest tick that was handed on


class Source(Protocol):
    """What records come from: the rings of a servo."""

    def feeds(self) -> Iterator[Feed]:
        """Where to take them from; the next one is asked for when the one before has come to its end."""


class Post(NamedTuple):
    """Memory of the relay.

    readers       everybody on this machine who wants records
    publisher_fd  eventfd that wakes the publisher
    bell_fd       and one that wakes readers in this process
    words         calls and the newest tick
    rows          (ROWS, width) as they come out of the ring
    seen          (fingers + 1,) what the guard changed in the last tick, and deadlines missed
    belled_s      (1,) time of the tick with which readers in this process were woken last
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
    """Hand on all that comes, until the feed is no longer at its turn number `turn` and everything of it is handed on:
    True; or until there have been more calls than `call`: False. `file` (1,) is overwritten."""
    told = True
    while True:
        turned = load_acquire(feed.turns, 0) != turn  # both before the ring is emptied: what came before is handed on
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
    """Hand on `count` ticks, rows (n, width); returns whether readers in this process were woken."""
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
    """Whether readers are to be woken with a tick: something has happened in it, or they were not for a while."""
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
    """Records for one thread of this process, which must not be late by more than HANDED_ON ticks."""

    def __init__(self, readers: Broadcast, bell_fd: int, ended: threading.Event, failed: threading.Event) -> None:
        self._readers, self._ended, self._failed = readers, ended, failed
        self._ring_fd, self._bell_fd = bell_fd, os.dup(bell_fd)  # a thread that reads late outlives the relay
        self.close: Final = weakref.finalize(self, os.close, self._bell_fd)
        """By who reads, in the end."""
        self._place = make_place(readers)
        read_rows.compile(_types(readers, self._place, np.empty((1, readers.slots.shape[1]))))  # type: ignore[attr-defined]

    def wait(self) -> None:
        """Sleep until there may be records, or the end of them."""
        wait_for(self._bell_fd)

    def wake(self) -> None:
        """End a `wait`, from any thread, as long as the relay is there."""
        os.eventfd_write(self._ring_fd, 1)

    def take(self, out: NDArray[np.float64]) -> int:
        """Copy the oldest to `out` (n, width); returns how many."""
        return read_rows(self._readers, self._place, out)

    @property
    def ended(self) -> bool:
        """Nothing more will come than can be taken now."""
        return self._ended.is_set()

    @property
    def failed(self) -> bool:
        """It has ended because the thread that hands on did, by an error of its own."""
        return self._failed.is_set()

    @property
    def lost(self) -> int:
        """Ticks it was too late for."""
        return int(self._place.lost[0])


class Relay:
    """The thread, and the memory in which it hands on the records of so many `fingers`."""

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
        """Where it sleeps while there is no servo."""
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
        """The same memory as a file that cannot be written to, for the publisher."""
        return self._memory.reading

    @property
    def rows(self) -> int:
        """How many were handed on."""
        return int(self._post.readers.head[0])

    @property
    def tick(self) -> int:
        """The newest that was handed on; -1: none was."""
        return int(self._post.words[_TICK])

    @property
    def native_id(self) -> int | None:
        """Of the thread."""
        return self._thread.native_id

    def attach(self, source: Source) -> None:
        """Hand on what a servo's rings have from here on, until it has ended. Once."""
        self._source = source
        self._call()

    def send(self, rows: NDArray[np.float64]) -> None:
        """Hand on ticks that come from no servo, shape (n, width). Not beside one."""
        if len(rows):
            hand_on_given(self._post, np.ascontiguousarray(rows))

    def close(self) -> None:
        """End the thread. Once."""
        self._closing.set()
        self._call()
        self._thread.join(JOIN_S)
        remove(self._memory)
        if not self._thread.is_alive():
            for file in (self._home.wake_fd, self._post.bell_fd, self.bell):
                os.close(file)

    def _call(self) -> None:
        """Have the thread come back to Python. Not from two threads at once."""
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
                        turn, self._asleep_on = 0, feed.wake_fd  # first: with its end the servo closes its own
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
    """Hand on rows (n, width) from Python."""
    hand_on(post, rows, len(rows))


def _types(*arguments: Any) -> tuple[Any, ...]:
    return tuple(numba.typeof(argument) for argument in arguments)
