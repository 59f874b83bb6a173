"""Sequence lock of the parameters and ring buffer of the records: none torn, lost or out of order between threads."""

import re
import threading
import time

import numba
import numpy as np
import pytest
from helpers.compiled_code import functions
from helpers.waits import WAIT_S

from softfinger.proxy.kernels.jit.atomics import load_relaxed, store_relaxed
from softfinger.proxy.kernels.jit.decorators import OPTIONS, entry
from softfinger.proxy.kernels.jit.seqlock import make_slot, publish, refresh
from softfinger.server.loop.rings import Rings, make_ring, push, take

READS = 10_000_000
WIDTH = 64


@entry
def publish_repeatedly(slot, values, flag):
    """Publish increasing numbers, the same in every element, until the flag is set."""
    number = slot.values[0]
    while load_relaxed(flag, 0) == 0:
        number += 1.0
        for i in range(values.shape[0]):
            values[i] = number
        publish(slot, values)
    return number


@entry
def read_repeatedly(slot, values, reads, flag):
    """Refresh `reads` times; return the numbers of torn, of older and of accepted copies."""
    version, torn, older, accepted, last = -1, 0, 0, 0, -1.0
    for _ in range(reads):
        sequence = refresh(slot, version, values)
        if sequence != version:
            version = sequence
            accepted += 1
            for i in range(1, values.shape[0]):
                if values[i] != values[0]:
                    torn += 1
                    break
            if values[0] < last:
                older += 1
            last = values[0]
    store_relaxed(flag, 0, 1)
    return torn, older, accepted


def test_no_read_is_torn_in_ten_million():
    slot, flag = make_slot(np.zeros(WIDTH)), np.ones(1, np.int64)
    publish_repeatedly(slot, np.zeros(WIDTH), flag)
    read_repeatedly(slot, np.zeros(WIDTH), 0, flag)
    torn, older, accepted, until = 0, 0, 0, time.monotonic() + WAIT_S
    while accepted <= 100 and time.monotonic() < until:  # on busy processors the two may not run simultaneously
        flag[0] = 0
        writer = threading.Thread(target=publish_repeatedly, args=(slot, np.zeros(WIDTH), flag))
        writer.start()
        counts = read_repeatedly(slot, np.zeros(WIDTH), READS, flag)
        writer.join()
        torn, older, accepted = torn + counts[0], older + counts[1], accepted + counts[2]
    assert (torn, older) == (0, 0)
    assert accepted > 100


def test_a_reader_keeps_its_copy_during_a_write():
    slot = make_slot(np.array([1.0]))
    values = np.zeros(1)
    version = refresh(slot, -1, values)
    slot.sequence[0] += 1
    assert refresh(slot, version, values) == version
    slot.sequence[0] += 1
    assert refresh(slot, version, values) == version + 2


def test_an_unchanged_value_is_not_copied():
    slot = make_slot(np.array([1.0]))
    values = np.zeros(1)
    version = refresh(slot, -1, values)
    values[0] = 5.0
    assert refresh(slot, version, values) == version and values[0] == 5.0
    publish(slot, np.array([2.0]))
    assert refresh(slot, version, values) != version and values[0] == 2.0


def compile_body(kernel, *arguments):
    dispatcher = numba.njit(**OPTIONS)(kernel.py_func)
    dispatcher.compile(tuple(numba.typeof(argument) for argument in arguments))
    (ir,) = dispatcher.inspect_llvm().values()
    (body,) = functions(ir).values()
    return body


STEPS = {
    "load acquire": r"load atomic i64,[^\n]* acquire",
    "load relaxed": r"load atomic i64,[^\n]* monotonic",
    "store relaxed": r"store atomic i64[^\n]* monotonic",
    "store release": r"store atomic i64[^\n]* release",
    "fence acquire": r"fence acquire",
    "fence release": r"fence release",
    "copy": r"store (?:double|<\d+ x double>)|@llvm\.mem(?:cpy|move)",
}


def find_followers(body):
    """Return, for each of STEPS in a body, the steps that can follow it on any path through its blocks."""
    label = r"[\w.$-]+"
    blocks = dict(re.findall(rf"^({label}):[^\n]*\n(.*?)(?=^{label}:|^}})", body, re.MULTILINE | re.DOTALL))
    steps, successors = {}, {}
    for name, text in blocks.items():
        matches = sorted((match.start(), step) for step, form in STEPS.items() for match in re.finditer(form, text))
        steps[name], successors[name] = [step for _, step in matches], set(re.findall(rf"label %({label})", text))

    def reached(name, visited):
        for successor in successors[name] - visited:
            visited.add(successor)
            reached(successor, visited)
        return visited

    after = {}
    for name, matches in steps.items():
        later = {step for block in reached(name, set()) for step in steps[block]}
        for number, step in enumerate(matches):
            after.setdefault(step, set()).update(matches[number + 1 :], later)
    return after


def test_compiled_code_has_the_order_of_the_lock():
    slot, values = make_slot(np.zeros(WIDTH)), np.zeros(WIDTH)
    assert find_followers(compile_body(refresh, slot, 0, values)) == {
        "load acquire": {"copy", "fence acquire", "load relaxed"},
        "copy": {"fence acquire", "load relaxed"},
        "fence acquire": {"load relaxed"},
        "load relaxed": set(),
    }
    assert find_followers(compile_body(publish, slot, values)) == {
        "load relaxed": {"store relaxed", "fence release", "copy", "store release"},
        "store relaxed": {"fence release", "copy", "store release"},
        "fence release": {"copy", "store release"},
        "copy": {"store release"},
        "store release": set(),
    }


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
    assert (take(ring, out), ring.drops[0]) == (4, 3) and out[:4, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert push(ring, np.array([7.0])) and take(ring, out) == 1 and out[0, 0] == 7.0


def test_drops_of_all_rings_are_counted():
    rings, out = Rings(), np.empty((8, 1))
    for first_number in (0.0, 10.0):
        ring = make_ring(2, 1)
        for _ in range(2):
            rings.add(ring)
        assert rings.newest is ring
        for n in range(5):
            push(ring, np.array([first_number + n]))
    for ring_records, drops in (([0.0, 1.0], 3), ([10.0, 11.0], 6), ([], 6)):
        count = rings.take(out)
        assert out[:count, 0].tolist() == ring_records and rings.drops == drops
    rings.close()
    assert rings.wake_fd < 0


def test_capacity_is_a_power_of_two():
    with pytest.raises(ValueError, match="capacity = 6"):
        make_ring(6, 1)
