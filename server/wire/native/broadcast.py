"""Ring buffer with one writer and any number of readers, which the writer neither knows nor waits for.

A reader copies rows and then checks whether the writer has overwritten them. A reader that is a full ring behind skips
to the middle of the ring and counts the rows missed. The relay of telemetry writes; shared-memory readers read.
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
from softfinger.proxy.kernels.jit.memory import copy_numbers


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
