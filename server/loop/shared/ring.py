"""Ring buffer of records with a single producer, the servo loop, and a single consumer.

The producer never waits: if the ring is full, it drops the record and counts it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, load_relaxed, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.memory import copy_numbers

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
