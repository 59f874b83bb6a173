"""Switch of the force: shared memory by which Python turns the force on and off, read in every tick.

A write needs neither a lock nor a new tuning, and the loop needs no interpreter. So the force turns off while Python is
busy, after a missing heartbeat, a request to the process of commands (`socket_process/force_off.py`), the loss of that
process, and a signal that ends the run (`server/signals.py`).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.atomics import load_acquire, store_release
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.server.loop.guard import Guard, GuardState
from softfinger.server.loop.switch_fields import (
    DEADLINE_NS,
    IS_ACTIVE,
    IS_REQUESTED,
    SIGNAL,
    STOPS_HANDLED,
    STOPS_RECEIVED,
    UNREACHABLE_NS,
)

NO_DEADLINE_NS: Final = np.iinfo(np.int64).max
MAX_OFF_S: Final = 0.006
"""Longest time, s, from the largest force to zero once the switch is off: that of 12 N at the default slew limit. A rig
with a slower limit, for a softer feel, must not delay `disarm` by it."""
UNREACHABLE_MAX_S: Final = 0.1
"""Longest time, s, for which the force continues while no request to turn it off could be received."""
UNREACHABLE_MAX_NS: Final = round(1e9 * UNREACHABLE_MAX_S)


def make_switch(words: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Return the memory of a switch that is on without a time limit."""
    switch = np.zeros(8, np.int64) if words is None else words
    switch[IS_REQUESTED], switch[DEADLINE_NS], switch[UNREACHABLE_NS] = 1, NO_DEADLINE_NS, -1
    return switch


@jit
def is_on(switch: NDArray[np.int64], now: int) -> bool:
    """Return whether the force is on at a time (ns)."""
    # The counts first: the daemon writes IS_REQUESTED before STOPS_HANDLED.
    handled = load_acquire(switch, STOPS_HANDLED) == load_acquire(switch, STOPS_RECEIVED)
    allowed = handled and load_acquire(switch, UNREACHABLE_NS) <= UNREACHABLE_MAX_NS
    requested = load_acquire(switch, IS_REQUESTED) != 0 and load_acquire(switch, SIGNAL) == 0
    return allowed and requested and now <= load_acquire(switch, DEADLINE_NS)


@jit
def count_unreachable(switch: NDArray[np.int64], period: int) -> None:
    """Add a tick of `period` ns to the time for which no request could be received.

    Missed ticks do not count: in a stall of the machine the process does not run either. A simultaneous reset may be
    overwritten, but the process repeats it.
    """
    time = load_acquire(switch, UNREACHABLE_NS)
    if time >= 0:
        store_release(switch, UNREACHABLE_NS, time + period)


@jit
def is_zero(guard_state: GuardState) -> bool:
    f, t = guard_state.force, guard_state.torque
    return f[0] == 0.0 and f[1] == 0.0 and f[2] == 0.0 and t[0] == 0.0 and t[1] == 0.0 and t[2] == 0.0


@jit
def apply_switch(guard: Guard, guard_state: GuardState, ignored_ticks: Any, on: bool) -> Guard:
    """Return the guard; if off, one that brings the wrench `guard_state` to zero within MAX_OFF_S and then disarms.

    ignored_ticks  (1 or more,)  number of successive ticks in which the device has kept `guard_state`

    The change of the ticks in which the device kept its wrench is made up for: its next answer may be far away, and a
    driver sends a zero without waiting for it.
    """
    if on:
        return guard
    armed = 0.0 if is_zero(guard_state) else guard.armed
    ticks = 1.0 + ignored_ticks[0]
    force_slew = ticks * max(guard.force_slew, guard.force_max / MAX_OFF_S)
    torque_slew = ticks * max(guard.torque_slew, guard.torque_max / MAX_OFF_S)
    return replace(
        guard, "force_max", 0.0, "torque_max", 0.0, "armed", armed, "force_slew", force_slew, "torque_slew", torque_slew
    )


@jit
def store_active(switch: NDArray[np.int64], hands: Any, on: bool) -> None:
    """Write IS_ACTIVE after a tick."""
    is_active = on
    for hand in hands:
        is_active |= not is_zero(hand.guard_state)
    store_release(switch, IS_ACTIVE, 1 if is_active else 0)
