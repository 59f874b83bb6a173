"""Switch of the force: reasons that inhibit it, and the ticks after which a change has taken effect."""

from __future__ import annotations

from math import ceil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config import limits
from softfinger.server.loop.force_switch import IS_ACTIVE, IS_REQUESTED, MAX_OFF_S, apply_switch, is_zero, make_switch
from softfinger.server.loop.guard import Guard, GuardState, guard_wrench
from softfinger.server.services.force import SWITCH_TICKS, Force
from softfinger.server.states import NOT_ARMED_REASON, TOO_FAST_REASON, States

pytestmark = pytest.mark.plain

TICKS = st.integers(0, 10_000)
NONE_IGNORED = np.zeros(2, np.int64)


class Loop:
    def __init__(self, unarmed: bool = False) -> None:
        self.ticks, self.switch = 0, make_switch()
        self.force = Force(unarmed, States(), self.switch, lambda: self.ticks)


@given(TICKS)
def test_force_is_off_after_the_loop_has_read_the_switch(at: int) -> None:
    """A tick in progress may not have read the switch; the force may still fade after it."""
    loop = Loop()
    loop.ticks, loop.switch[IS_ACTIVE] = at, 0
    loop.force.inhibit(TOO_FAST_REASON)
    assert loop.switch[IS_REQUESTED] == 0 and not loop.force.is_requested
    loop.ticks = at + SWITCH_TICKS - 1
    assert not loop.force.is_off
    loop.ticks = at + SWITCH_TICKS
    assert loop.force.is_off
    loop.switch[IS_ACTIVE] = 1
    assert not loop.force.is_off


@given(TICKS)
def test_force_is_on_when_no_reason_inhibits_it(at: int) -> None:
    """`switched_on_tick` excludes ticks that may have started without the force."""
    loop = Loop(unarmed=True)
    loop.ticks = at
    assert loop.switch[IS_REQUESTED] == 0
    loop.force.inhibit(TOO_FAST_REASON)
    loop.force.allow(NOT_ARMED_REASON)
    assert (
        loop.switch[IS_REQUESTED] == 0
        and loop.force.is_inhibited_by(TOO_FAST_REASON)
        and not loop.force.is_inhibited_by(NOT_ARMED_REASON)
    )
    loop.force.allow(TOO_FAST_REASON)
    assert loop.switch[IS_REQUESTED] == 1 and loop.force.switched_on_tick == at + SWITCH_TICKS
    loop.ticks = at + 100
    loop.force.allow(TOO_FAST_REASON)
    assert loop.force.switched_on_tick == at + SWITCH_TICKS  # already on


@given(TICKS)
def test_a_suspended_force_returns_unless_inhibited(at: int) -> None:
    """A suspension is not a reason, and clears none."""
    loop = Loop()
    loop.ticks = at
    with loop.force.suspend():
        assert loop.switch[IS_REQUESTED] == 0 and loop.force.is_requested
    assert loop.switch[IS_REQUESTED] == 1 and loop.force.switched_on_tick == at + SWITCH_TICKS
    with loop.force.suspend():
        loop.force.inhibit(NOT_ARMED_REASON)
    assert loop.switch[IS_REQUESTED] == 0


def floats_within(span: limits.Range) -> st.SearchStrategy[float]:
    return st.floats(span.low, span.high)


@given(
    floats_within(limits.FORCE_MAX_N), floats_within(limits.TORQUE_MAX_NM), floats_within(limits.FORCE_SLEW_N_PER_S),
    floats_within(limits.TORQUE_SLEW_NM_PER_S), floats_within(limits.RATE_HZ),
)  # fmt: skip
def test_no_rig_delays_the_end_of_the_force(
    force: float, torque: float, force_slew: float, torque_slew: float, rate_hz: float
) -> None:
    """From the limits of any rig the force falls to zero in MAX_OFF_S, to the tick, for any commanded wrench."""
    guard = Guard(force, torque, force_slew, torque_slew, 0.5, 1.0)
    guarded = GuardState((0.0, 0.0, force), (0.0, torque, 0.0), 1.0)
    for _ in range(ceil(MAX_OFF_S * rate_hz * (1.0 + 1e-12))):  # rounding of the product
        now = apply_switch(guard, guarded, NONE_IGNORED, False)
        guarded, _bits = guard_wrench(now, guarded, (0.0, 0.0, 99.0), (0.0, 9.0, 0.0), 1.0 / rate_hz, 1.0 / rate_hz)
    assert max(map(abs, guarded.force + guarded.torque)) <= 1e-12 * (force + torque)  # rounding of the steps
    if not is_zero(guarded):
        guarded, _bits = guard_wrench(
            apply_switch(guard, guarded, NONE_IGNORED, False),
            guarded,
            (1.0, 0.0, 0.0),
            (0.0, 0.0, 0.0),
            1.0 / rate_hz,
            1.0 / rate_hz,
        )
    assert is_zero(guarded)


@given(floats_within(limits.FORCE_MAX_N), floats_within(limits.TORQUE_MAX_NM), floats_within(limits.RATE_HZ))
def test_a_device_that_ignores_wrenches_gets_the_zero_in_time(force: float, torque: float, rate_hz: float) -> None:
    """A device that is busy keeps its wrench, but accepts a zero: it must not wait for an answer for each step."""
    guard, ignored_ticks = Guard(force, torque, 1.0, 1.0, 0.5, 1.0), NONE_IGNORED.copy()
    kept = GuardState((0.0, 0.0, force), (0.0, torque, 0.0), 1.0)
    commanded = kept
    for _ in range(ceil(MAX_OFF_S * rate_hz * (1.0 + 1e-12))):  # rounding of the product
        now = apply_switch(guard, kept, ignored_ticks, False)
        commanded, _bits = guard_wrench(now, kept, (0.0, 0.0, 99.0), (0.0, 9.0, 0.0), 1.0 / rate_hz, 1.0 / rate_hz)
        ignored_ticks[0] += 1
    assert max(map(abs, commanded.force + commanded.torque)) <= 1e-12 * (force + torque)  # rounding of the steps
