"""Numbers sent to the running servo and back: a sequence lock with one writer, which never waits for readers.

The counter is odd during a write. A reader that meets a write, or is overtaken by one, continues with its previous
numbers and retries in its next tick.
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
from softfinger.proxy.kernels.jit.memory import copy_numbers


class Slot(NamedTuple):
    """Shared memory of a sequence lock: sequence (8,) int64, word 0 is the counter; values (n,) float64."""

    sequence: NDArray[np.int64]
    values: NDArray[np.float64]


def make_slot(values: NDArray[np.float64]) -> Slot:
    """Return a slot that contains `values`."""
    return Slot(np.zeros(8, np.int64), values.copy())


@jit
def store(slot: Slot, values: NDArray[np.float64]) -> None:
    """Replace the values (n,) of a slot, from a kernel. For one thread only."""
    sequence = load_relaxed(slot.sequence, 0)
    store_relaxed(slot.sequence, 0, sequence + 1)
    fence_release()
    copy_numbers(slot.values, values)
    store_release(slot.sequence, 0, sequence + 2)


@entry
def publish(slot: Slot, values: NDArray[np.float64]) -> None:
    """Replace the values of a slot from Python, as `store`."""
    store(slot, values)


@entry
def read(slot: Slot, known_sequence: int, values: NDArray[np.float64]) -> int:
    """Copy a slot from Python, as `refresh`."""
    return refresh(slot, known_sequence, values)


@jit
def refresh(slot: Slot, known_sequence: int, values: NDArray[np.float64]) -> int:
    """Copy the slot to `values` (n,) if it changed since sequence `known_sequence`.

    returns  the sequence of `values`: equal to `known_sequence` if there was no change or a write was in progress; then
             `values` must not be used, because it may contain parts of two writes
    """
    before = load_acquire(slot.sequence, 0)
    if before == known_sequence or before & 1:
        return known_sequence
    copy_numbers(values, slot.values)
    fence_acquire()
    if load_relaxed(slot.sequence, 0) != before:
        return known_sequence
    return before
