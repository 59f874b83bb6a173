"""States of the daemon: every way in the table is gone, and no other."""

from itertools import product

import pytest

from softfinger.server.states import (
    CAUSES,
    COMMANDED,
    FAST,
    FAULTS,
    MEANINGS,
    SILENT,
    TRANSITIONS,
    UNARMED,
    State,
    States,
    Trigger,
)

pytestmark = pytest.mark.plain

WAYS = {
    State.STARTING: [],
    State.READY: [Trigger.TICK],
    State.ARMED: [Trigger.TICK, Trigger.ARM],
    State.FAULTED: [Trigger.TICK, Trigger.FAULT],
    State.STOPPING: [Trigger.END],
}
"""How each state is come to."""

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


def states_in(state):
    """States that are in one of them, and what they tell from there on."""
    told = []
    states = States(lambda *change: told.append(change))
    for trigger in WAYS[state]:
        assert states.fire(trigger, "on the way")
    assert states.now is state
    told.clear()
    return states, told


@pytest.mark.parametrize(("state", "trigger"), list(product(State, Trigger)))
def test_a_trigger_leads_where_it_should_and_else_nowhere(state, trigger):
    """Each trigger in each state: the expected way, told with its cause, or none, and nothing told."""
    states, told = states_in(state)
    after = EXPECTED.get(f"{state} {trigger}")
    assert states.fire(trigger, "because") == (after is not None)
    assert states.now == (after or state)
    assert told == ([] if after is None else [(state, State(after), "because")])


def test_the_table_is_whole():
    """It has the expected ways; every state and trigger says what it is; stopping is the end."""
    assert {f"{state} {trigger}": after for (state, trigger), after in TRANSITIONS.items()} == EXPECTED
    assert set(MEANINGS) == set(State) and set(CAUSES) == set(Trigger)
    assert not any(state is State.STOPPING for state, _ in TRANSITIONS)


@pytest.mark.parametrize(
    ("begun", "reasons", "after"),
    [
        (State.STARTING, set(), []),
        (State.READY, set(), ["armed"]),
        (State.READY, {UNARMED}, []),
        (State.READY, {SILENT}, ["faulted"]),
        (State.ARMED, set(), []),
        (State.ARMED, {COMMANDED}, ["ready"]),
        (State.ARMED, {FAST, COMMANDED}, ["faulted"]),
        (State.FAULTED, {SILENT}, []),
        (State.FAULTED, set(), ["ready", "armed"]),
        (State.FAULTED, {COMMANDED}, ["ready"]),
        (State.STOPPING, set(), []),
    ],
)
def test_the_state_follows_what_keeps_the_force_off(begun, reasons, after):
    """No reason is armed, a fault faulted, any other ready; told step by step, and once."""
    states, told = states_in(begun)
    for _ in range(2):
        states.follow(reasons)
    assert [str(change[1]) for change in told] == after
    if after == ["faulted"] or (reasons and after):
        assert told[-1][2] == ", ".join(sorted(reasons))


def test_an_error_that_ends_the_run_is_cleared_by_nothing():
    """Once failed, whatever keeps the force off or does not, the state is faulted until the end."""
    states, told = states_in(State.ARMED)
    states.fail("the device is gone")
    for reasons in (set(), {COMMANDED}, {SILENT}):
        states.follow(reasons)
    assert told == [(State.ARMED, State.FAULTED, "the device is gone")]
    assert states.fire(Trigger.END, "done") and states.now is State.STOPPING


def test_what_is_a_fault_is_a_reason():
    """A hand that nobody has armed, or that somebody disarmed, is no fault."""
    assert {SILENT, FAST} == FAULTS and not FAULTS & {UNARMED, COMMANDED}
