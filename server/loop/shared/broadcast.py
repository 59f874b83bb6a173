"""Records from one writer to any number of readers, none of whom it waits for or knows of.

A reader copies a row and then looks whether the writer has come round meanwhile. One that falls behind by the whole
ring goes on from half of it, and counts what it missed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import (
    fence_acquire,
    fence_release,
    load_acquire,
    load_relaxed,
    store_release,
)
from softfinger.proxy.kernels.jit.decorators import entry, jit


class Broadcast(NamedTuple):
    """slots (capacity, width) float64, capacity a power of two; word 0 of head (8,) int64 counts the rows written, the
    others are for whoever wakes readers."""

    slots: NDArray[np.float64]
    head: NDArray[np.int64]


class Place(NamedTuple):
    """A reader's, (1,) each: the row it reads next, and how many it missed."""

    next: NDArray[np.int64]
    lost: NDArray[np.int64]


def make_broadcast(capacity: int, width: int) -> Broadcast:
    """An empty one for `capacity` rows (a power of two) of `width` numbers."""
    if capacity < 2 or capacity & (capacity - 1):
        raise ValueError(f"capacity = {capacity}: a broadcast's capacity is a power of two, 2 or more")
    return Broadcast(np.zeros((capacity, width)), np.zeros(8, np.int64))


def make_place(broadcast: Broadcast) -> Place:
    """A reader's that begins with the next row."""
    return Place(broadcast.head[:1].copy(), np.zeros(1, np.int64))


@jit
def write_row(broadcast: Broadcast, rows: NDArray[np.float64], row: int) -> None:
    """Copy `rows[row]`, (width,), in place of the oldest."""
    head = load_relaxed(broadcast.head, 0)
    slot = head & (broadcast.slots.shape[0] - 1)
    fence_release()  # whoever sees a number of this row sees that all before it were written
    for i in range(broadcast.slots.shape[1]):
        broadcast.slots[slot, i] = rows[row, i]
    store_release(broadcast.head, 0, head + 1)


@entry
def read_rows(broadcast: Broadcast, place: Place, out: NDArray[np.float64]) -> int:
    """Copy up to len(out) rows to `out` (n, width), oldest first; returns how many."""
    capacity = broadcast.slots.shape[0]
    while True:
        first, head = place.next[0], load_acquire(broadcast.head, 0)
        if head - first >= capacity:  # the oldest may be being overwritten
            place.next[0] = head - capacity // 2
            place.lost[0] += place.next[0] - first
            continue
        count = min(head - first, out.shape[0])
        for k in range(count):
            slot = (first + k) & (capacity - 1)
            for i in range(out.shape[1]):
                out[k, i] = broadcast.slots[slot, i]
        fence_acquire()
        if load_relaxed(broadcast.head, 0) - first < capacity:
            place.next[0] = first + count
            return int(count)
