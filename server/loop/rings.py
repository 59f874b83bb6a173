"""Ring buffers of records, from the servo loop to its single reader.

The loop never waits: if a ring is full, it drops the record and counts it. The reader sleeps on an eventfd.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, load_relaxed, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.memory import copy_numbers
from softfinger.server.loop.eventfd import wait_for_eventfd

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
    `wait`, then `take` until it returns 0. A reader without Python uses `iter_feeds`.
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

    def iter_feeds(self) -> Iterator[Feed]:
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
