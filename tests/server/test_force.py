"""Switch of the force, arming computed from records, and the states of the daemon."""

from itertools import product
from math import ceil
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config import limits
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server import states as machine
from softfinger.server.loop.force_switch import MAX_OFF_S, apply_switch, is_zero, make_switch
from softfinger.server.loop.guard import DISARMED, RAMPING, TOO_FAST, Guard, GuardState, guard_wrench
from softfinger.server.loop.switch_fields import IS_ACTIVE, IS_REQUESTED
from softfinger.server.services.arming import Arming
from softfinger.server.services.force import SWITCH_TICKS, Force
from softfinger.server.states import COMMANDED_REASON, NOT_ARMED_REASON, TOO_FAST_REASON, DaemonState, Trigger

pytestmark = pytest.mark.plain

TICKS = st.integers(0, 10_000)
NONE_IGNORED = np.zeros(2, np.int64)


class Loop:
    def __init__(self, unarmed: bool = False) -> None:
        self.ticks, self.switch = 0, make_switch()
        self.force = Force(unarmed, machine.StateMachine(), self.switch, lambda: self.ticks)


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
    loop.force.inhibit(COMMANDED_REASON)  # a further reason changes nothing
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
    assert loop.switch[IS_REQUESTED] == 0
    assert loop.force.is_inhibited_by(TOO_FAST_REASON) and not loop.force.is_inhibited_by(NOT_ARMED_REASON)
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


def count_off_ticks(rate_hz: float) -> int:
    return ceil(MAX_OFF_S * rate_hz * (1.0 + 1e-12))  # rounding of the product


def run_off_tick(guard: Guard, guarded: GuardState, ignored_ticks: np.ndarray, rate_hz: float) -> GuardState:
    """Return the state after a tick in which a large wrench is commanded while the force is switched off."""
    now, dt = apply_switch(guard, guarded, ignored_ticks, False), 1.0 / rate_hz
    return guard_wrench(now, guarded, (0.0, 0.0, 99.0), (0.0, 9.0, 0.0), dt, dt)[0]


@given(
    floats_within(limits.FORCE_MAX_N), floats_within(limits.TORQUE_MAX_NM), floats_within(limits.FORCE_SLEW_N_PER_S),
    floats_within(limits.TORQUE_SLEW_NM_PER_S), floats_within(limits.RATE_HZ),
)  # fmt: skip
def test_no_rig_delays_the_end_of_the_force(force, torque, force_slew, torque_slew, rate_hz):
    """From the limits of any rig the force falls to zero in MAX_OFF_S, to the tick, for any commanded wrench."""
    guard = Guard(force, torque, force_slew, torque_slew, 0.5, 1.0)
    guarded = GuardState((0.0, 0.0, force), (0.0, torque, 0.0), 1.0)
    for _ in range(count_off_ticks(rate_hz)):
        guarded = run_off_tick(guard, guarded, NONE_IGNORED, rate_hz)
    assert max(map(abs, guarded.force + guarded.torque)) <= 1e-12 * (force + torque)  # rounding of the steps
    if not is_zero(guarded):
        guarded = run_off_tick(guard, guarded, NONE_IGNORED, rate_hz)
    assert is_zero(guarded)


@given(floats_within(limits.FORCE_MAX_N), floats_within(limits.TORQUE_MAX_NM), floats_within(limits.RATE_HZ))
def test_a_device_that_ignores_wrenches_gets_the_zero_in_time(force: float, torque: float, rate_hz: float) -> None:
    """A device that is busy keeps its wrench, but accepts a zero: it must not wait for an answer for each step."""
    guard, ignored_ticks = Guard(force, torque, 1.0, 1.0, 0.5, 1.0), NONE_IGNORED.copy()
    kept = GuardState((0.0, 0.0, force), (0.0, torque, 0.0), 1.0)
    commanded = kept
    for _ in range(count_off_ticks(rate_hz)):
        commanded = run_off_tick(guard, kept, ignored_ticks, rate_hz)
        ignored_ticks[0] += 1
    assert max(map(abs, commanded.force + commanded.torque)) <= 1e-12 * (force + torque)  # rounding of the steps


WAYS = {
    DaemonState.STARTING: [],
    DaemonState.READY: [Trigger.TICK],
    DaemonState.ARMED: [Trigger.TICK, Trigger.ARM],
    DaemonState.FAULTED: [Trigger.TICK, Trigger.FAULT],
    DaemonState.STOPPING: [Trigger.END],
}
"""Triggers that lead to each state."""

EXPECTED = {
    "starting tick": "ready", "starting fault": "faulted", "starting end": "stopping", "ready arm": "armed",
    "ready fault": "faulted", "ready end": "stopping", "armed disarm": "ready", "armed fault": "faulted",
    "armed end": "stopping", "faulted clear": "ready", "faulted end": "stopping",
}  # fmt: skip


def make_states(state):
    """Return states at `state` and the list of their later notifications."""
    changes = []
    states = machine.StateMachine(lambda *change: changes.append(change))
    for trigger in WAYS[state]:
        assert states.fire(trigger, "on the way")
    assert states.now is state
    changes.clear()
    return states, changes


@pytest.mark.parametrize(("state", "trigger"), list(product(DaemonState, Trigger)))
def test_a_trigger_leads_where_it_should_and_else_nowhere(state, trigger):
    states, changes = make_states(state)
    after = EXPECTED.get(f"{state} {trigger}")
    assert states.fire(trigger, "because") == (after is not None) and states.now == (after or state)
    assert changes == ([] if after is None else [(state, DaemonState(after), "because")])


def test_the_table_is_complete():
    assert {f"{state} {trigger}": after for (state, trigger), after in machine.TRANSITIONS.items()} == EXPECTED
    assert set(machine.MEANINGS) == set(DaemonState) and set(machine.CAUSES) == set(Trigger)
    assert not any(state is DaemonState.STOPPING for state, _ in machine.TRANSITIONS)


@pytest.mark.parametrize(
    ("begun", "reasons", "after"),
    [
        (DaemonState.STARTING, set(), []),
        (DaemonState.READY, set(), ["armed"]),
        (DaemonState.READY, {NOT_ARMED_REASON}, []),
        (DaemonState.READY, {machine.NO_HEARTBEAT_REASON}, ["faulted"]),
        (DaemonState.READY, {machine.UNREACHABLE_REASON}, ["faulted"]),
        (DaemonState.ARMED, set(), []),
        (DaemonState.ARMED, {COMMANDED_REASON}, ["ready"]),
        (DaemonState.ARMED, {TOO_FAST_REASON, COMMANDED_REASON}, ["faulted"]),
        (DaemonState.FAULTED, {machine.NO_HEARTBEAT_REASON}, []),
        (DaemonState.FAULTED, set(), ["ready", "armed"]),
        (DaemonState.FAULTED, {COMMANDED_REASON}, ["ready"]),
        (DaemonState.STOPPING, set(), []),
    ],
)
def test_the_state_follows_the_reasons_for_no_force(begun, reasons, after):
    states, changes = make_states(begun)
    for _ in range(2):
        states.follow(reasons)
    assert [str(change[1]) for change in changes] == after
    if after == ["faulted"] or (reasons and after):
        assert changes[-1][2] == ", ".join(sorted(reasons))


def test_an_error_that_ends_the_run_is_cleared_by_nothing():
    states, changes = make_states(DaemonState.ARMED)
    states.fail("the device is gone")
    for reasons in (set(), {COMMANDED_REASON}, {machine.NO_HEARTBEAT_REASON}):
        states.follow(reasons)
    assert changes == [(DaemonState.ARMED, DaemonState.FAULTED, "the device is gone")]
    assert states.fire(Trigger.END, "done") and states.now is DaemonState.STOPPING


class DaemonStub:
    """Rendering that records the calls of `Arming` in order; `armed_at` is the first armed tick."""

    def __init__(self, arm: str, fingers: int = 1, armed_at: int = 0) -> None:
        self.rig = SimpleNamespace(guard=SimpleNamespace(arm=arm))
        self.servo = SimpleNamespace(devices=[None] * fingers)
        self.acts: list[Any] = []
        self.force = SimpleNamespace(
            switched_on_tick=armed_at,
            note_guard=lambda reason, tick: self.acts.append((reason, tick)),
            update_state=lambda: self.acts.append("update_state"),
        )

    def disarm(self, reason: str) -> None:
        self.acts.append(("disarm", reason))

    def arm(self, *reasons: str) -> None:
        self.acts.append(("arm", *reasons))


def batch(*ticks: tuple[int, list[tuple[float, float]]]) -> np.ndarray:
    out = np.zeros((len(ticks), len(ticks[0][1]) * RECORD_SIZE))
    for row, (tick, fingers) in zip(out, ticks, strict=True):
        for place, (bits, buttons) in enumerate(fingers):
            row[place * RECORD_SIZE + AT.tick] = tick
            row[place * RECORD_SIZE + AT.servo_guard], row[place * RECORD_SIZE + AT.buttons] = bits, buttons
    return out


def process_batches(daemon: DaemonStub, *batches: np.ndarray) -> list[Any]:
    arming = Arming(daemon, machine.StateMachine())
    for records in batches:
        arming.take(records, 0)
    return [act for act in daemon.acts if act != "update_state"]


@pytest.mark.parametrize("fingers", [1, 2])
def test_automatic_arming_reports_if_the_last_tick_was_too_fast(fingers: int) -> None:
    slow, fast = [(RAMPING, 0.0)] * fingers, [(0.0, 0.0)] * (fingers - 1) + [(TOO_FAST | RAMPING, 0.0)]
    assert process_batches(DaemonStub("automatic", fingers), batch((1, slow), (2, fast))) == [(TOO_FAST_REASON, True)]
    assert process_batches(DaemonStub("automatic", fingers), batch((1, fast), (2, slow))) == [(TOO_FAST_REASON, False)]


@pytest.mark.parametrize(
    ("armed_at", "tick", "bits", "is_too_fast"),
    [(0, 1, TOO_FAST | DISARMED, False), (8, 7, TOO_FAST, False), (8, 8, TOO_FAST, True)],
)
def test_a_disarmed_guard_is_not_too_fast(armed_at: int, tick: int, bits: int, is_too_fast: bool) -> None:
    acts = process_batches(DaemonStub("automatic", armed_at=armed_at), batch((tick, [(bits, 0)])))
    assert acts == [(TOO_FAST_REASON, is_too_fast)]


@pytest.mark.parametrize("arm", ["command", "button"])
def test_too_fast_disarms_with_arming_by_command_or_button(arm: str) -> None:
    assert process_batches(DaemonStub(arm), batch((1, [(TOO_FAST, 0)]), (2, [(0, 0)]))) == [("disarm", TOO_FAST_REASON)]
    assert process_batches(DaemonStub(arm), batch((1, [(0, 0)]))) == []


ARMED = [("arm", NOT_ARMED_REASON, TOO_FAST_REASON)]


def test_a_press_arms_if_the_rig_arms_by_button() -> None:
    press = batch((1, [(0, 0)]), (2, [(0, 1)]), (3, [(0, 1)]))
    assert process_batches(DaemonStub("button"), press) == ARMED
    assert process_batches(DaemonStub("command"), press) == []


@pytest.mark.parametrize(
    ("words", "armed"),
    [
        ([1.0, 1.0, 0.0], False),  # down from the start, then released
        ([0.0, 0.0], False),
        ([1.0, 0.0, 1.0], True),  # pressed again
        ([1.0, 3.0], True),  # a second button pressed
        ([3.0, 1.0], False),
        ([0.0, np.nan], False),
        ([0.0, np.inf], False),
        ([0.0, -1.0], False),
        ([0.0, 2.0**53], False),  # invalid: above 2**52 a float64 cannot represent every integer
        ([0.0, 2.0**52], True),
    ],
)
def test_a_press_is_a_button_that_was_up(words: list[float], armed: bool) -> None:
    ticks = [(number, [(0.0, word)]) for number, word in enumerate(words)]
    assert process_batches(DaemonStub("button"), batch(*ticks)) == (ARMED if armed else [])
    assert process_batches(DaemonStub("button"), *[batch(tick) for tick in ticks]) == (ARMED if armed else [])


@pytest.mark.parametrize("late", range(-3, 4))
def test_only_a_press_after_a_fast_handle_arms(late: int) -> None:
    """Also if both are in one batch, as after a delay of this service."""
    ticks = [(tick, [(TOO_FAST * (3 <= tick <= 4), float(tick == 4 + late))]) for tick in range(1, 9)]
    acts = process_batches(DaemonStub("button"), batch(*ticks))
    assert acts == 2 * [("disarm", TOO_FAST_REASON)] + (ARMED if late >= 0 else [])


def test_any_finger_may_press() -> None:
    assert process_batches(DaemonStub("button", 2), batch((1, [(0, 0), (0, 0)]), (2, [(0, 0), (0, 2)]))) == ARMED
    assert process_batches(DaemonStub("button", 2), batch((1, [(0, 1), (0, 0)]), (2, [(0, 0), (0, 1)]))) == []
