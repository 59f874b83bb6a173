"""The fault model: every row has a test that injects it, and every event that tells a fault has a row."""

import ast
import importlib
import json
from pathlib import Path

import pytest

from softfinger.server.faults import ADVICE, FAILED, HAZARDS, SEEN_IN
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.loop.health import STALL_MAX_S, STALL_POLL_S, STALL_POLLS
from softfinger.server.states import State

pytestmark = pytest.mark.plain

ROOT = Path(__file__).parents[2]
ORDINARY = {"force_clamped", "torque_clamped", "slew_limited", "disarmed"}
"""What the guard does to a force of every day, or by command."""
TURN = 5
"""Ticks that a thread of a far end may wait for its turn of the scheduler."""


def functions(file):
    """Names of a file's functions."""
    tree = ast.parse((ROOT / file).read_text("utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def faults_told():
    """Names of events of kind `fault` in the program, wherever one is published."""
    names = set()
    for path in sorted((ROOT / "server").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call) or len(node.args) < 2:
                continue
            kind, name = node.args[:2]
            if isinstance(kind, ast.Constant) and kind.value == "fault" and isinstance(name, ast.Constant | ast.Name):
                module = ".".join(("softfinger", *path.relative_to(ROOT).with_suffix("").parts))
                constant = isinstance(name, ast.Constant)
                names.add(name.value if constant else getattr(importlib.import_module(module), name.id))
    return names


def test_each_row_is_injected_by_a_test_that_there_is():
    """Each hazard names at least one test, and each test is in its file."""
    for hazard in HAZARDS:
        assert hazard.tests, hazard.name
        for test in hazard.tests:
            file, _, name = test.partition("::")
            assert name in functions(file), test


def test_each_fault_that_is_told_has_a_row():
    """Every event of kind `fault`, every bit of the guard but what is ordinary, and nothing that does not exist."""
    rows = {event for hazard in HAZARDS for event in hazard.events}
    faults = {f"fault {name}" for name in faults_told()}
    assert len(faults) >= 9
    assert {row for row in rows if row.startswith("fault ")} == faults
    assert {row for row in rows if row.startswith("guard ")} == {f"guard {name}" for name in {*GUARD_NAMES} - ORDINARY}
    assert rows - faults - {f"guard {name}" for name in GUARD_NAMES} == {
        "servo missed", "command heartbeat_missed", FAILED,
    }  # fmt: skip
    assert f"state {State.FAULTED}" == FAILED


def test_each_row_was_seen_to_fit_what_it_says():
    """Of what `make faults-seen` has written each case passed, and none that noted a reaction took longer than its row
    allows, a far end's handover and its thread's turn beside."""
    seen = json.loads(SEEN_IN.read_text("utf-8"))
    assert all(each["passed"] == each["of"] for each in seen if "test" in each)
    by_name = {hazard.name: hazard for hazard in HAZARDS}
    timed = set()
    for each in (each for each in seen if "driver" in each):
        hazard = by_name[each["hazard"]]
        assert each["event"] == "none" or each["event"] in hazard.events, each
        assert each["state"] in set(State), each
        if each["ticks"] is None:
            assert hazard.within is None, each
        else:
            timed.add(hazard.name)
            assert each["ticks"] <= hazard.within + each.get("handover", 0) + TURN, each
    assert len(timed) >= 7


def test_the_row_of_a_stall_says_what_the_supervisor_does():
    """From its number of looks to the most that it may take, in words and in ticks at 1 kHz."""
    (stall,) = [hazard for hazard in HAZARDS if hazard.name == "a loop that stalls"]
    assert stall.reaction == f"{STALL_POLLS * STALL_POLL_S:.2f} to {STALL_MAX_S:.2f} s"
    assert stall.within == round(1000 * STALL_MAX_S)


def test_rows_are_told_apart():
    """No two hazards have one name, and none leaves a field empty but its events."""
    assert len({hazard.name for hazard in HAZARDS}) == len(HAZARDS)
    assert all(all(hazard[:5]) for hazard in HAZARDS)


def test_advice_is_for_events_of_the_guard():
    """What to do is said of every guard event that tells a fault, and of no other."""
    assert set(ADVICE) == {*GUARD_NAMES} - ORDINARY - {"ramping"}
