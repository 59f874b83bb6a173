"""Records from the servo to one reader: a ring with a single producer and a single consumer.

The producer never waits. A record that finds the ring full is dropped and counted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, load_relaxed, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit

_CACHE_LINE = 8
"""int64 words; producer and consumer write to different cache lines."""


class Ring(NamedTuple):
    """slots (capacity, width) float64, capacity a power of two; head, tail, drops are counters in word 0."""

    slots: NDArray[np.float64]
    head: NDArray[np.int64]
    tail: NDArray[np.int64]
    drops: NDArray[np.int64]


class Feed(NamedTuple):
    """A ring, and how its reader learns of what is in it.

    turns    word 0 counts how often a ring has come to its end: nothing more is pushed to it
    wake_fd  eventfd that is written after each push, and after each turn
    """

    ring: Ring
    turns: NDArray[np.int64]
    wake_fd: int


def make_ring(capacity: int, width: int) -> Ring:
    """An empty ring for `capacity` records (a power of two) of `width` numbers; its pages are touched."""
    if capacity < 1 or capacity & (capacity - 1):
        raise ValueError(f"capacity = {capacity}: a ring's capacity is a power of two")
    slots = np.empty((capacity, width))
    slots.fill(0.0)
    head, tail, drops = (np.zeros(_CACHE_LINE, np.int64) for _ in range(3))
    return Ring(slots, head, tail, drops)


@jit
def push(ring: Ring, record: NDArray[np.float64]) -> bool:
    """Copy `record` (width,) into the ring; False, and counted, when it is full."""
    head = load_relaxed(ring.head, 0)
    if head - load_acquire(ring.tail, 0) >= ring.slots.shape[0]:
        store_release(ring.drops, 0, load_relaxed(ring.drops, 0) + 1)
        return False
    slot = head & (ring.slots.shape[0] - 1)
    for i in range(ring.slots.shape[1]):
        ring.slots[slot, i] = record[i]
    store_release(ring.head, 0, head + 1)
    return True


@entry
def take(ring: Ring, out: NDArray[np.float64]) -> int:
    """Move up to len(out) records into `out` (n, width), oldest first; returns how many."""
    tail = load_relaxed(ring.tail, 0)
    count = min(load_acquire(ring.head, 0) - tail, out.shape[0])
    for k in range(count):
        slot = (tail + k) & (ring.slots.shape[0] - 1)
        for i in range(out.shape[1]):
            out[k, i] = ring.slots[slot, i]
    store_release(ring.tail, 0, tail + count)
    return count
