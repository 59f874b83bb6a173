"""Ring buffers of records: from the servo loop to its single reader, and from the relay to any number of readers.

A writer never waits. If a `Ring` is full, the loop drops the record and counts it. A reader of a `Broadcast` copies
rows and then checks whether the writer has overwritten them; a reader that is a full ring behind skips to the middle of
the ring and counts the rows missed. Readers sleep on an eventfd.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import (
    fence_acquire,
    fence_release,
    load_acquire,
    load_relaxed,
    store_release,
)
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.memory import address_of, copy_numbers

_CACHE_LINE = 8
"""Number of int64 in a cache line; producer and consumer write to different ones."""


class Ring(NamedTuple):
    """Ring buffer; `head`, `tail` and `drops` are counters in element 0.

    slots  (capacity, width)  float64, capacity is a power of two
    """

    slots: NDArray[np.float64]
    head: NDArray[np.int64]
    tail: NDArray[np.int64]
    drops: NDArray[np.int64]


class Feed(NamedTuple):
    """Ring and the notification of its reader.

    completed_rings  element 0 counts the rings that are complete: no record is pushed to them any more
    wake_fd          eventfd, written after each push and after each increment of `completed_rings`
    """

    ring: Ring
    completed_rings: NDArray[np.int64]
    wake_fd: int


def make_ring(capacity: int, width: int) -> Ring:
    """Return an empty ring for `capacity` records (a power of two) of `width` numbers; its pages are touched."""
    if capacity < 1 or capacity & (capacity - 1):
        raise ValueError(f"capacity = {capacity}: a ring's capacity is a power of two")
    slots = np.empty((capacity, width))
    slots.fill(0.0)
    head, tail, drops = (np.zeros(_CACHE_LINE, np.int64) for _ in range(3))
    return Ring(slots, head, tail, drops)


@jit
def push(ring: Ring, record: NDArray[np.float64]) -> bool:
    """Copy `record` (width,) into the ring; if the ring is full, count a drop and return False."""
    head = load_relaxed(ring.head, 0)
    if head - load_acquire(ring.tail, 0) >= ring.slots.shape[0]:
        store_release(ring.drops, 0, load_relaxed(ring.drops, 0) + 1)
        return False
    copy_numbers(ring.slots[head & (ring.slots.shape[0] - 1)], record)
    store_release(ring.head, 0, head + 1)
    return True


@entry
def take(ring: Ring, out: NDArray[np.float64]) -> int:
    """Move up to len(out) records into `out` (n, width), oldest first; returns the number of records."""
    tail = load_relaxed(ring.tail, 0)
    count = min(load_acquire(ring.head, 0) - tail, out.shape[0])
    for k in range(count):
        copy_numbers(out[k], ring.slots[(tail + k) & (ring.slots.shape[0] - 1)])
    store_release(ring.tail, 0, tail + count)
    return count


class Rings:
    """Current ring, followed by the ring of the next loop if that uses another one.

    `add` and `end` are called by the servo thread, everything else by the reader, in one thread. The reader calls
    `wait`, then `take` until it returns 0. A reader without Python uses `feeds`.
    """

    def __init__(self) -> None:
        self.wake_fd = os.eventfd(0)
        """Eventfd, written after each record and after each change of rings."""
        self._completed_rings: Final = np.zeros(8, np.int64)
        self._rings: Final = list[Ring]()
        self._dropped = 0

    @property
    def newest(self) -> Ring | None:
        """Ring of the loop that runs or ran last."""
        return self._rings[-1] if self._rings else None

    @property
    def drops(self) -> int:
        """Records dropped because a ring was full."""
        return self._dropped + int(self._rings[0].drops[0])

    def add(self, ring: Ring) -> None:
        """Append the ring of a new loop, unless the loop reuses the previous ring."""
        if ring is self.newest:
            return
        self._rings.append(ring)
        if len(self._rings) > 1:
            self._completed_rings[0] += 1

    def end(self) -> None:
        """Mark the last ring as complete and wake the reader."""
        self._completed_rings[0] += 1
        os.eventfd_write(self.wake_fd, 1)

    def wait(self) -> None:
        """Sleep until a record is available or the last ring is complete."""
        wait_for_eventfd(self.wake_fd)

    def take(self, out: NDArray[np.float64]) -> int:
        """Move the oldest records into `out` (n, width), a row per tick; returns the number of rows."""
        is_complete = len(self._rings) > 1  # read before the ring is emptied: a finished loop adds no record
        count = int(take(self._rings[0], out))
        if count == 0 and is_complete:
            self._drop_first()
            count = int(take(self._rings[0], out))
        return count

    def feeds(self) -> Iterator[Feed]:
        """Yield each ring once the previous one is complete and empty; the last one completes when the servo ends."""
        yield Feed(self._rings[0], self._completed_rings, self.wake_fd)
        while len(self._rings) > 1:
            self._drop_first()
            yield Feed(self._rings[0], self._completed_rings, self.wake_fd)

    def close(self) -> None:
        """Release the eventfd; call it after the reader has stopped."""
        if self.wake_fd >= 0:
            os.close(self.wake_fd)
            self.wake_fd = -1

    def _drop_first(self) -> None:
        self._dropped += int(self._rings[0].drops[0])
        del self._rings[0]


def wait_for_eventfd(fd: int) -> None:
    """Sleep until the counter of an eventfd is above zero, and reset it.

    Retries after EINTR: the kernel may deliver a signal to any thread, and Python does not retry this call.
    """
    while True:
        try:
            os.eventfd_read(fd)
        except InterruptedError:
            continue
        return


class Broadcast(NamedTuple):
    """Ring buffer of rows.

    slots  (capacity, width)  float64, capacity is a power of two
    head   (8,)               int64; element 0 counts the rows written, the others are free for waking readers
    """

    slots: NDArray[np.float64]
    head: NDArray[np.int64]


class ReadPosition(NamedTuple):
    """Read position of one reader.

    next  (1,)  row that is read next
    lost  (1,)  rows missed
    """

    next: NDArray[np.int64]
    lost: NDArray[np.int64]


def make_read_position(broadcast: Broadcast) -> ReadPosition:
    """Return the read position of a reader that starts at the next row."""
    return ReadPosition(broadcast.head[:1].copy(), np.zeros(1, np.int64))


@jit
def write_row(broadcast: Broadcast, rows: NDArray[np.float64], row: int) -> None:
    """Copy `rows[row]` (width,) into the buffer, over the oldest row."""
    head = load_relaxed(broadcast.head, 0)
    fence_release()  # a reader that sees part of this row also sees the count of the rows before it
    copy_numbers(broadcast.slots[head & (broadcast.slots.shape[0] - 1)], rows[row])
    store_release(broadcast.head, 0, head + 1)


@entry
def read_rows(broadcast: Broadcast, position: ReadPosition, out: NDArray[np.float64]) -> int:
    """Copy up to len(out) rows to `out` (n, width), oldest first; returns the number of rows."""
    capacity = broadcast.slots.shape[0]
    while True:
        first, head = position.next[0], load_acquire(broadcast.head, 0)
        if head - first >= capacity:  # the writer may be overwriting the oldest row
            position.next[0] = head - capacity // 2
            position.lost[0] += position.next[0] - first
            continue
        count = min(head - first, out.shape[0])
        for k in range(count):
            copy_numbers(out[k], broadcast.slots[(first + k) & (capacity - 1)])
        fence_acquire()
        if load_relaxed(broadcast.head, 0) - first < capacity:
            position.next[0] = first + count
            return int(count)


_POLLIN: Final = 1

_poll: Any = types.ExternalFunction("poll", types.int32(types.int64, types.uint64, types.int32))
_read: Any = types.ExternalFunction("read", types.int64(types.int32, types.int64, types.uint64))
_eventfd_write: Any = types.ExternalFunction("eventfd_write", types.int32(types.int32, types.uint64))


@jit
def wake_eventfd(fd: int) -> None:
    """Wake the thread or process that sleeps on an eventfd."""
    _eventfd_write(fd, 1)


@jit
def reset_eventfd(fd: int, word: NDArray[np.int64]) -> None:
    """Reset an eventfd after a signal; waits without one. `word` (1,) is scratch."""
    _read(fd, address_of(word, 0), 8)


@jit
def wait_eventfd(fd: int, timeout_ms: int, word: NDArray[np.int64]) -> bool:
    """Sleep until an eventfd is signalled; return False on a timeout or a signal. `word` (1,) is scratch."""
    word[0] = _POLLIN << 32 | fd  # a pollfd is one int64: the file in the low half, the requested events above it
    return bool(_poll(address_of(word, 0), 1, timeout_ms) > 0)
