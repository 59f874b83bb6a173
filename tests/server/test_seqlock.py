"""Sequence lock of the parameters: ten million reads against a writer, none torn."""

import re
import threading
import time

import numba
import numpy as np
from helpers.compiled_code import functions

from softfinger.proxy.kernels.jit.atomics import load_relaxed, store_relaxed
from softfinger.proxy.kernels.jit.decorators import OPTIONS, entry
from softfinger.proxy.kernels.jit.seqlock import make_slot, publish, refresh

READS = 10_000_000
WIDTH = 64
WAIT_S = 120.0


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
