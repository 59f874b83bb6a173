"""Switch of the force: shared memory by which Python turns the force on and off, read in every tick.

A write needs neither a lock nor a new tuning, and the loop needs no interpreter. A missing heartbeat therefore turns
the force off while Python is busy, and so does a request that the publisher received (`publishing/brake.py`).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, store_release
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_count
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.server.loop.guard import Guard, Guarded
from softfinger.server.loop.switch_words import ASKED, OBEYED

WANTED: Final = 0
"""1: force is requested."""
UNTIL: Final = 1
"""Time, ns on CLOCK_MONOTONIC, at which the force turns off unless it is extended."""
GIVEN: Final = 2
"""Written by the loop: 1 if a hand was given a force in the last tick, or the switch was on."""
FOREVER: Final = np.iinfo(np.int64).max
OFF_S: Final = 0.006
"""Longest time, s, from the largest force to zero once the switch is off: that of 12 N at the default slew limit. A rig
with a slower limit, for a softer feel, must not delay `disarm` by it."""


def make_switch(words: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Return the memory of a switch that is on without a time limit."""
    switch = np.zeros(8, np.int64) if words is None else words
    switch[WANTED], switch[UNTIL] = 1, FOREVER
    return switch


@jit
def is_on(switch: NDArray[np.int64], now: int) -> bool:
    """Return whether the force is on at a time (ns)."""
    # The counts first: the daemon writes WANTED before OBEYED.
    obeyed = load_acquire(switch, OBEYED) == load_acquire(switch, ASKED)
    return obeyed and load_acquire(switch, WANTED) != 0 and now <= load_acquire(switch, UNTIL)


@jit
def is_zero(given: Guarded) -> bool:
    f, t = given.force, given.torque
    return f[0] == 0.0 and f[1] == 0.0 and f[2] == 0.0 and t[0] == 0.0 and t[1] == 0.0 and t[2] == 0.0


@jit
def switched(guard: Guard, given: Guarded, on: bool) -> Guard:
    """Return the guard; if off, one that brings the wrench `given` to zero within OFF_S and then disarms."""
    if on:
        return guard
    armed = 0.0 if is_zero(given) else guard.armed
    force_slew = max(guard.force_slew, guard.force_max / OFF_S)
    torque_slew = max(guard.torque_slew, guard.torque_max / OFF_S)
    return replace(
        guard, "force_max", 0.0, "torque_max", 0.0, "armed", armed, "force_slew", force_slew, "torque_slew", torque_slew
    )


@by_count
def switched_all(guards: Any, hands: Any, on: bool) -> Any:
    """Return `switched` of each guard, for the last wrenches of the FingerMemories `hands`."""


@switched_all.of(1)
def switched_one(guards: Any, hands: Any, on: bool) -> Any:
    return (switched(guards[0], hands[0].guarded, on),)


@switched_all.of(2)
def switched_several(guards: Any, hands: Any, on: bool) -> Any:
    return switched_all(guards[:1], hands[:1], on) + switched_all(guards[1:], hands[1:], on)


@by_count
def all_zero(hands: Any) -> Any:
    """Return whether no hand was given a wrench."""


@all_zero.of(1)
def one_zero(hands: Any) -> bool:
    return is_zero(hands[0].guarded)


@all_zero.of(2)
def several_zero(hands: Any) -> bool:
    return is_zero(hands[0].guarded) and all_zero(hands[1:])


@jit
def note_given(switch: NDArray[np.int64], hands: Any, on: bool) -> None:
    """Write GIVEN after a tick."""
    store_release(switch, GIVEN, 0 if not on and all_zero(hands) else 1)
