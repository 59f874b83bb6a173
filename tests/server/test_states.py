"""States of the daemon: every transition of the table, and no other."""

from itertools import product

import pytest

from softfinger.server.states import (
    CAUSES,
    COMMANDED_REASON,
    FAULT_REASONS,
    MEANINGS,
    NO_HEARTBEAT_REASON,
    NOT_ARMED_REASON,
    TOO_FAST_REASON,
    TRANSITIONS,
    UNREACHABLE,
    DaemonState,
    States,
    Trigger,
)

pytestmark = pytest.mark.plain

WAYS = {
    DaemonState.STARTING: [],
    DaemonState.READY: [Trigger.TICK],
    DaemonState.ARMED: [Trigger.TICK, Trigger.ARM],
    DaemonState.FAULTED: [Trigger.TICK, Trigger.FAULT],
    DaemonState.STOPPING: [Trigger.END],
}
"""Triggers that lead to each state."""

EXPECTED = {
    "starting tick": "ready",
    "starting fault": "faulted",
    "starting end": "stopping",
    "ready arm": "armed",
    "ready fault": "faulted",
    "ready end": "stopping",
    "armed disarm": "ready",
    "armed fault": "faulted",
    "armed end": "stopping",
    "faulted clear": "ready",
    "faulted end": "stopping",
}


def make_states(state):
    """Return states at `state` and the list of their later notifications."""
    changes = []
    states = States(lambda *change: changes.append(change))
    for trigger in WAYS[state]:
        assert states.fire(trigger, "on the way")
    assert states.now is state
    changes.clear()
    return states, changes


@pytest.mark.parametrize(("state", "trigger"), list(product(DaemonState, Trigger)))
def test_a_trigger_leads_where_it_should_and_else_nowhere(state, trigger):
    states, changes = make_states(state)
    after = EXPECTED.get(f"{state} {trigger}")
    assert states.fire(trigger, "because") == (after is not None)
    assert states.now == (after or state)
    assert changes == ([] if after is None else [(state, DaemonState(after), "because")])


def test_the_table_is_complete():
    assert {f"{state} {trigger}": after for (state, trigger), after in TRANSITIONS.items()} == EXPECTED
    assert set(MEANINGS) == set(DaemonState) and set(CAUSES) == set(Trigger)
    assert not any(state is DaemonState.STOPPING for state, _ in TRANSITIONS)


@pytest.mark.parametrize(
    ("begun", "reasons", "after"),
    [
        (DaemonState.STARTING, set(), []),
        (DaemonState.READY, set(), ["armed"]),
        (DaemonState.READY, {NOT_ARMED_REASON}, []),
        (DaemonState.READY, {NO_HEARTBEAT_REASON}, ["faulted"]),
        (DaemonState.ARMED, set(), []),
        (DaemonState.ARMED, {COMMANDED_REASON}, ["ready"]),
        (DaemonState.ARMED, {TOO_FAST_REASON, COMMANDED_REASON}, ["faulted"]),
        (DaemonState.FAULTED, {NO_HEARTBEAT_REASON}, []),
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
    for reasons in (set(), {COMMANDED_REASON}, {NO_HEARTBEAT_REASON}):
        states.follow(reasons)
    assert changes == [(DaemonState.ARMED, DaemonState.FAULTED, "the device is gone")]
    assert states.fire(Trigger.END, "done") and states.now is DaemonState.STOPPING


def test_which_reasons_are_faults():
    assert {NO_HEARTBEAT_REASON, TOO_FAST_REASON, UNREACHABLE} == FAULT_REASONS and not FAULT_REASONS & {
        NOT_ARMED_REASON,
        COMMANDED_REASON,
    }
