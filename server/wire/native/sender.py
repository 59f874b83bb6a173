"""The thread that sends: it sleeps until the servo has a record, and wakes, encodes and sends without the interpreter.

It alone empties the servo's ring. What it took it hands on to everybody on this machine who wants records, by a
broadcast of its own: they are woken by it, not by the servo; those in this process only where something has happened,
or at times.
"""

from __future__ import annotations

import logging
import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.native.atomics import load_acquire
from softfinger.proxy.kernels.native.jit import entry, jit
from softfinger.proxy.kernels.native.outlined import outlined
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.shared.broadcast import Broadcast, make_place, read_rows, write_row
from softfinger.server.loop.shared.ring import Feed, make_ring, take
from softfinger.server.progress import making
from softfinger.server.wire.native.backlog import (
    BELL,
    FD,
    PEERS_MAX,
    TICK,
    WAITING,
    Backlog,
    advance,
    append,
    attend,
    broadcast,
    flush,
    make_backlog,
)
from softfinger.server.wire.native.memory import make_memory, remove, ring_readers, wake_readers
from softfinger.server.wire.native.system import (
    POLLIN,
    POLLOUT,
    asked,
    happened,
    lock,
    ring,
    silence,
    sleep_on,
    unlock,
)
from softfinger.server.wire.native.templates import (
    SETS,
    Plan,
    Shown,
    contact_template,
    make_plan,
    whole,
    write_message,
)

log: Final = logging.getLogger(__name__)

ROWS: Final = 64
"""Most ticks that are taken from the ring at a time."""

HANDED_ON: Final = 8192
"""Ticks that a reader in this process may fall behind: 8 s at 1 kHz, 1 s at 8 kHz."""

BELL_MS: Final = 10
"""Readers in this process are woken at once where something has happened, and else this often: each wake-up of
Python costs as much as sending a hundred ticks."""
_BELL_S: Final = BELL_MS / 1000.0

JOIN_S: Final = 1.0


class Source(Protocol):
    """What records come from: a servo."""

    def feeds(self) -> Iterator[Feed]:
        """Where to take them from; the next one is asked for when the one before has come to its end."""


class Post(NamedTuple):
    """Memory of the sender.

    backlog    what is sent, and to whom
    readers    everybody on this machine who wants records
    bell_fd    eventfd that wakes them
    calls      word 0 counts how often the thread was asked back to Python
    rows       (ROWS or fewer, width) as they come out of the ring
    files      (1 + PEERS_MAX,) pollfds
    waiting    (1 + PEERS_MAX,) number of the peer that each of them is
    seen       (fingers + 1,) what the guard changed in the last tick, and deadlines missed
    belled_s   (1,) time of the tick with which readers were woken last
    """

    backlog: Backlog
    readers: Broadcast
    bell_fd: int
    calls: NDArray[np.int64]
    rows: NDArray[np.float64]
    files: NDArray[np.int64]
    waiting: NDArray[np.int64]
    seen: NDArray[np.float64]
    belled_s: NDArray[np.float64]


@entry
def serve(post: Post, plan: Plan, feed: Feed, turn: int, call: int) -> bool:
    """Send all that comes, until the feed is no longer at its turn number `turn` and everything of it is sent: True; or
    until there have been more calls than `call`: False."""
    log = post.backlog
    lock(log.lock)
    log.words[BELL] = feed.wake_fd
    unlock(log.lock)
    told = True
    while True:
        turned = load_acquire(feed.turns, 0) != turn  # both before the ring is emptied: what came before is sent
        called = load_acquire(post.calls, 0) != call
        count = take(feed.ring, post.rows)
        while count > 0:
            told = send_rows(post, plan, post.rows, count)
            count = take(feed.ring, post.rows)
        if turned or called:
            break
        files = _files(post, feed.wake_fd)
        any_happened = sleep_on(post.files, files, -1 if told else BELL_MS)
        if any_happened and happened(post.files[0]):
            silence(feed.wake_fd, post.files)
        elif not any_happened and not told:
            told = True
            ring(post.bell_fd)
        if any_happened and files > 1:
            _advance_waiting(post, files)
    lock(log.lock)
    log.words[BELL] = -1
    unlock(log.lock)
    return bool(turned)


@jit
def _files(post: Post, wake_fd: int) -> int:
    """Pollfds of the feed and of the peers that wait; how many."""
    log, count = post.backlog, 1
    post.files[0] = asked(wake_fd, POLLIN)
    lock(log.lock)
    for peer in range(PEERS_MAX):
        if log.peers[peer, FD] >= 0 and log.peers[peer, WAITING]:
            post.files[count], post.waiting[count] = asked(log.peers[peer, FD], POLLOUT), peer
            count += 1
    unlock(log.lock)
    return count


@jit
def _advance_waiting(post: Post, files: int) -> None:
    log = post.backlog
    lock(log.lock)
    for i in range(1, files):
        peer = post.waiting[i]
        if happened(post.files[i]) and log.peers[peer, FD] >= 0 and log.peers[peer, WAITING]:
            advance(log, peer)
    unlock(log.lock)


@outlined
def send_rows(post: Post, plan: Plan, rows: NDArray[np.float64], count: int) -> bool:
    """Send `count` ticks, rows (n, width); returns whether readers in this process were woken."""
    log, told = post.backlog, False
    lock(log.lock)
    for r in range(count):
        tick = whole(rows[r, AT.tick])
        log.words[TICK] = tick
        if tick % plan.every == 0:
            for finger in range(plan.fingers):
                _send_one(log, plan, contact_template(plan, rows, r, finger), finger, rows, r, finger)
        if tick % plan.state_every == 0:
            _send_one(log, plan, plan.fingers * SETS, plan.fingers, rows, r, 0)
    if flush(log):
        ring(log.words[BELL])
    unlock(log.lock)
    for r in range(count):
        write_row(post.readers, rows, r)
        told = _matters(post, plan, rows, r) or told
    wake_readers(post.readers)
    if told:
        ring(post.bell_fd)
    return told


@jit
def _send_one(
    log: Backlog, plan: Plan, template: int, topic: int, rows: NDArray[np.float64], row: int, finger: int
) -> None:
    write_message(plan, template, rows, row, finger, log.data, append(log, topic, plan.sizes[template]))


@jit
def _matters(post: Post, plan: Plan, rows: NDArray[np.float64], row: int) -> bool:
    """Whether readers are to be woken with a tick: something has happened in it, or they were not for a while."""
    since = rows[row, AT.timestamp] - post.belled_s[0]
    matters = not 0.0 <= since < _BELL_S
    for finger in range(plan.fingers):
        column = finger * RECORD_SIZE
        guard = rows[row, column + AT.servo_guard]
        matters = matters or rows[row, column + AT.contact_cause] != 0.0 or guard != post.seen[finger]
        post.seen[finger] = guard
    matters = matters or rows[row, AT.servo_missed] != post.seen[plan.fingers]
    post.seen[plan.fingers] = rows[row, AT.servo_missed]
    if matters:
        post.belled_s[0] = rows[row, AT.timestamp]
    return bool(matters)


class Tap:
    """Records for one thread of this process, which must not be late by more than HANDED_ON ticks."""

    def __init__(self, readers: Broadcast, bell_fd: int, ended: threading.Event, failed: threading.Event) -> None:
        self._readers, self._ended, self._failed = readers, ended, failed
        self._ring_fd, self._bell_fd = bell_fd, os.dup(bell_fd)  # a thread that reads late outlives the sender
        self.close: Final = weakref.finalize(self, os.close, self._bell_fd)
        """By who reads, in the end."""
        self._place = make_place(readers)
        read_rows.compile(_types(readers, self._place, np.empty((1, readers.slots.shape[1]))))  # type: ignore[attr-defined]

    def wait(self) -> None:
        """Sleep until there may be records, or the end of them."""
        os.eventfd_read(self._bell_fd)

    def wake(self) -> None:
        """End a `wait`, from any thread, as long as the sender is there."""
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
        """It has ended because the thread that sends did, by an error of its own."""
        return self._failed.is_set()

    @property
    def lost(self) -> int:
        """Ticks it was too late for."""
        return int(self._place.lost[0])


class Sender:
    """The backlog, the thread that sends, and what it hands on.

    fingers   their names, '' of a single one; topics 0, 1, ... are theirs, and the one behind them is `state`
    every     a tick of theirs is sent in so many
    topics    how many there are in all
    retained  those, as bits, whose newest message a new subscriber is given at once
    messages  kept for those who fall behind
    """

    def __init__(self, fingers: Sequence[str], every: int, topics: int, retained: int, messages: int) -> None:
        self._fingers, self._every = tuple(fingers), every
        self._plan = make_plan(fingers, every, Shown())
        width = len(fingers) * RECORD_SIZE
        # A part at a time: more than the backlog at once would be lost to those, too, who take all at once.
        rows = max(1, min(ROWS, messages // (4 * (len(fingers) + 1))))
        bell = os.eventfd(0)
        self._memory = make_memory(HANDED_ON, width)
        self.backlog: Final = make_backlog(messages, self._plan.templates.shape[1], topics, retained)
        self._post: Final = Post(
            self.backlog,
            self._memory.broadcast,
            bell,
            np.zeros(8, np.int64),
            np.empty((rows, width)),
            np.zeros(1 + PEERS_MAX, np.int64),
            np.zeros(1 + PEERS_MAX, np.int64),
            np.zeros(len(fingers) + 1),
            np.full(1, -np.inf),
        )
        self._home: Final = Feed(make_ring(1, width), np.zeros(8, np.int64), os.eventfd(0))
        """Where it sleeps while there is no servo."""
        self._source: Source | None = None
        self._done, self._failed, self._closing = (threading.Event() for _ in range(3))
        self.tap: Final = Tap(self._post.readers, bell, self._done, self._failed)
        self._compile()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def _compile(self) -> None:
        nothing = np.zeros(0, np.uint8)
        kernels: list[tuple[Any, tuple[Any, ...]]] = [
            (serve, (self._post, self._plan, self._home, 0, 0)),
            (attend, (self.backlog, 0, 0, 0, nothing)),
            (broadcast, (self.backlog, 0, nothing)),
            (ring_readers, (self._post.readers,)),
        ]
        with making("kernels that send telemetry"):
            for kernel, given in kernels:
                kernel.compile(_types(*given))

    @property
    def memory(self) -> str:
        """Name under which programs of this user find every tick, '' if they cannot."""
        return self._memory.name

    def attach(self, source: Source) -> None:
        """Send what a servo's rings have from here on, until it has ended. Once."""
        self._source = source
        self._call()

    def show(self, shown: Shown) -> None:
        """What `state` says from here on."""
        self._plan = make_plan(self._fingers, self._every, shown)
        self._call()

    def send(self, rows: NDArray[np.float64]) -> None:
        """Send ticks that come from no servo, shape (n, width), after all that was sent before."""
        part = len(self._post.rows)
        for at in range(0, len(rows), part):
            send_given(self._post, self._plan, np.ascontiguousarray(rows[at : at + part]))

    def close(self) -> None:
        """End the thread; what still waits for a peer is given up. Once."""
        self._closing.set()
        self._call()
        self._thread.join(JOIN_S)
        remove(self._memory)
        if not self._thread.is_alive():
            os.close(self._home.wake_fd)
            os.close(self._post.bell_fd)

    def _call(self) -> None:
        """Have the thread come back to Python. Not from two threads at once."""
        self._post.calls[0] += 1
        if (fd := int(self.backlog.words[BELL])) >= 0:  # else it is on its way, and looks at the calls first
            os.eventfd_write(fd, 1)

    def _run(self) -> None:
        feeds, feed, turn = None, self._home, 0
        try:
            while True:
                call = int(self._post.calls[0])
                if self._closing.is_set():
                    return
                if feeds is None and self._source is not None:
                    feeds = self._source.feeds()
                    feed = next(feeds)
                if serve(self._post, self._plan, feed, turn, call) and feeds is not None:
                    turn, feed = turn + 1, next(feeds, self._home)
                    if feed is self._home:
                        turn = 0
                        self._end()
        except Exception:
            self._failed.set()
            log.exception("telemetry: the thread that sends failed")
            self._end()

    def _end(self) -> None:
        self._done.set()
        self.tap.wake()


@entry
def send_given(post: Post, plan: Plan, rows: NDArray[np.float64]) -> None:
    """Send rows (n, width) at once, n as for `Post.rows`."""
    send_rows(post, plan, rows, len(rows))


def _types(*arguments: Any) -> tuple[Any, ...]:
    return tuple(numba.typeof(argument) for argument in arguments)
