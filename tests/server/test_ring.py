"""Ring buffer: many records between two threads, none torn, lost or out of order."""

import threading

import numpy as np
import pytest

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.server.loop.rings import make_ring, push, take

WIDTH = 16


@entry
def push_numbered(ring, record, first, last):
    """Push records in which every column is the record number; retries while the ring is full, so none is lost."""
    for number in range(first, last):
        for i in range(record.shape[0]):
            record[i] = number
        while not push(ring, record):
            pass


@entry
def check_numbered(records, count, expected):
    """Return how many of the first `count` records are not `expected`, `expected` + 1, ... in every column."""
    wrong = 0
    for k in range(count):
        for i in range(records.shape[1]):
            if records[k, i] != expected + k:
                wrong += 1
                break
    return wrong


@pytest.mark.scaled
def test_records_arrive_complete_and_in_order(cases):
    records = cases(300_000, 10_000_000)
    ring = make_ring(1024, WIDTH)
    push_numbered(ring, np.zeros(WIDTH), 0, 0)  # compiled before the thread starts
    producer = threading.Thread(target=push_numbered, args=(ring, np.zeros(WIDTH), 0, records))
    producer.start()
    out, total, wrong = np.empty((1024, WIDTH)), 0, 0
    while total < records:
        count = take(ring, out)
        wrong += check_numbered(out, count, total)
        total += count
    producer.join()
    assert (total, wrong) == (records, 0)


def test_a_full_ring_drops_new_records_and_counts_them():
    ring = make_ring(4, 1)
    pushed = [push(ring, np.array([float(n)])) for n in range(7)]
    out = np.empty((8, 1))
    assert pushed == [True] * 4 + [False] * 3
    assert (take(ring, out), ring.drops[0]) == (4, 3)
    assert out[:4, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert push(ring, np.array([7.0])) and take(ring, out) == 1 and out[0, 0] == 7.0


def test_capacity_is_a_power_of_two():
    with pytest.raises(ValueError, match="capacity = 6"):
        make_ring(6, 1)
