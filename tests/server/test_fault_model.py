"""The fault model: every row has a test that injects it, and every event that tells a fault has a row."""

import ast
import importlib
import json
import re
from pathlib import Path

import pytest
from helpers.injected_run import FROZEN_S

from softfinger.config.errors import DeviceError, HapticError, SafetyStop
from softfinger.drivers import base
from softfinger.drivers.openhaptics import exchange as openhaptics
from softfinger.server.loop import health, limits
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.services import device_warnings, swapping
from softfinger.server.states import DaemonState
from softfinger.server.viewer.door import process
from softfinger.server.wire import link
from softfinger.server.wire.events import ADVICE
from softfinger.tools.pages import hazards
from softfinger.tools.pages.hazards import FAILED, HAZARDS, SEEN_IN

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
    assert f"state {DaemonState.FAULTED}" == FAILED


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
        assert each["state"] in set(DaemonState), each
        if each["ticks"] is None:
            assert hazard.within is None, each
        else:
            timed.add(hazard.name)
            assert each["ticks"] <= hazard.within + each.get("handover", 0) + TURN, each
    assert len(timed) >= 7


SET_BY = {
    "a wall that is unstable": [(limits, "FORGET_S")],
    "a force that is not finite": [(health, "NO_FORCE_MAX_S")],
    "a pose that is not finite, out of range or short": [(health, "NO_FORCE_MAX_S")],
    "a pose that jumps": [(health, "NO_FORCE_MAX_S"), (health, "JUMP_S")],
    "a handle that runs away": [(limits, "SPEED_S"), (limits, "SLOW_S")],
    "a device that warns": [(device_warnings, "PERIOD_S")],
    "a device that is lost or breaks its protocol": [(DeviceError, "exit_code")],
    "a device that is silent, or sends invalid data": [(openhaptics, "TIMEOUT_NS"), (DeviceError, "exit_code")],
    "a device that takes no force": [(base, "IGNORED_WRENCH_MAX_S")],
    "a device that removes its force": [(SafetyStop, "exit_code")],
    "a loop that stalls": [(health, name) for name in ("STALL_POLLS", "STALL_POLL_S", "STALL_MAX_S")],
    "a machine that starves the loop": [
        (health, name) for name in ("LOST_MAX_S", "LOST_SHARE", "GAP_MIN_S", "GAP_MAX_S")
    ],
    "an exception in the servo's thread": [(HapticError, "exit_code")],
    "a process of telemetry or commands that ends, also while no memory or file descriptor is left": [
        (link, "PAUSE_MAX_S")
    ],
    "a page that ends, also while no memory or file descriptor is left": [(process, "RESTARTS")],
    "memory of the daemon in swap": [(swapping, "PERIOD_S")],
    "commands that cannot be taken": [(SafetyStop, "exit_code")],
}
"""The constants that set the numbers of a row; keys of rigs have their defaults in the reference of rigs."""


@pytest.mark.parametrize(("name", "owner", "constant"), [
    (name, owner, constant) for name, constants in SET_BY.items() for owner, constant in constants
])  # fmt: skip
def test_a_number_of_a_row_is_that_of_its_constant(name, owner, constant, monkeypatch):
    """Another value of the constant makes another row."""
    row = {hazard.name: tuple(hazard) for hazard in HAZARDS}[name]
    value = getattr(owner, constant)
    monkeypatch.setattr(owner, constant, 1.5 * value if isinstance(value, float) else 2 * value)
    try:
        other = {hazard.name: tuple(hazard) for hazard in importlib.reload(hazards).HAZARDS}[name]
    finally:
        monkeypatch.undo()
        importlib.reload(hazards)
    assert other != row


BY_HAND = {"0 ticks", "0 ticks, 1 of a write"}
"""Reactions that no constant sets: the same tick, which tests see at every driver."""


def test_no_number_of_a_row_is_written_by_hand():
    """Of the texts from which rows are made none has a figure but those that no constant sets."""
    (rows,) = [
        node.value
        for node in ast.parse((ROOT / "tools/pages/hazards.py").read_text("utf-8")).body
        if isinstance(node, ast.AnnAssign) and node.target.id == "HAZARDS"
    ]
    texts = [
        each.value
        for row in rows.elts
        for field in row.args[:5]
        for each in ast.walk(field)
        if isinstance(each, ast.Constant) and isinstance(each.value, str)
    ]
    assert len(texts) > 5 * len(HAZARDS) // 2
    by_hand = {text for text in texts if re.search(r"\d|\b(twice|three|five|half)\b", text)}
    assert by_hand - {".0%", ".1f", ".2f"} == BY_HAND


def test_what_tests_may_take_is_what_their_rig_says():
    """The rig of the injected faults waits FROZEN_S for a pose that stands still; a fifth more is the tests'."""
    (frozen,) = [hazard for hazard in HAZARDS if hazard.name == "a pose that does not change under a force"]
    assert frozen.within == round(1.2 * FROZEN_S / hazards.TICK_S)


def test_rows_are_told_apart():
    """No two hazards have one name, and none leaves a field empty but its events."""
    assert len({hazard.name for hazard in HAZARDS}) == len(HAZARDS)
    assert all(all(hazard[:5]) for hazard in HAZARDS)


def test_advice_is_for_events_of_the_guard():
    """What to do is said of every guard event that tells a fault, and of no other."""
    assert set(ADVICE) == {*GUARD_NAMES} - ORDINARY - {"ramping"}
