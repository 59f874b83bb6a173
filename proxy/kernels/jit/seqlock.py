"""Numbers into the running servo, and out of it: a sequence lock with one writer, which readers never hold up.

The counter is odd while the writer is at work. A reader that meets a write, or is overtaken by one,
keeps what it had and tries again at its next tick.
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
    store_relaxed,
    store_release,
)
from softfinger.proxy.kernels.jit.decorators import entry, jit


class Slot(NamedTuple):
    """sequence (8,) int64, word 0 counts; values (n,) float64."""

    sequence: NDArray[np.int64]
    values: NDArray[np.float64]


def make_slot(values: NDArray[np.float64]) -> Slot:
    """A slot that holds `values`."""
    return Slot(np.zeros(8, np.int64), values.copy())


@jit
def store(slot: Slot, values: NDArray[np.float64]) -> None:
    """Replace the slot's values (n,), from a kernel. One thread only."""
    sequence = load_relaxed(slot.sequence, 0)
    store_relaxed(slot.sequence, 0, sequence + 1)
    fence_release()
    for i in range(slot.values.shape[0]):
        slot.values[i] = values[i]
    store_release(slot.sequence, 0, sequence + 2)


@entry
def publish(slot: Slot, values: NDArray[np.float64]) -> None:
    """`store` for Python."""
    store(slot, values)


@entry
def read(slot: Slot, seen: int, values: NDArray[np.float64]) -> int:
    """`refresh` for Python."""
    return refresh(slot, seen, values)


@jit
def refresh(slot: Slot, seen: int, values: NDArray[np.float64]) -> int:
    """Copy the slot to `values` (n,) if it changed since sequence `seen`.

    returns  the sequence now held in `values`: `seen` when nothing is new or a write was under way, and
             then `values` must not be used, since it may hold a torn copy
    """
    before = load_acquire(slot.sequence, 0)
    if before == seen or before & 1:
        return seen
    for i in range(slot.values.shape[0]):
        values[i] = slot.values[i]
    fence_acquire()
    if load_relaxed(slot.sequence, 0) != before:
        return seen
    return before
