"""Fault model: every row has a test that injects it, and every published fault has a row."""

import ast
import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.injected_run import FROZEN_S

from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.states import DaemonState
from softfinger.server.wire.events import REMEDIES
from softfinger.tools.pages import hazards
from softfinger.tools.pages.hazards import FAILED, HAZARDS, RESULTS_FILE

pytestmark = pytest.mark.plain

ROOT = Path(__file__).parents[2]
ORDINARY = {"force_clamped", "torque_clamped", "slew_limited", "disarmed"}
"""Guard bits of normal operation or of a command."""
TURN = 5
"""Ticks that a thread of a far end may wait for the scheduler."""


def iter_fault_names(path: Path) -> Iterator[str]:
    """Yield the names of the events of kind `fault` that a module publishes, directly or by a PeriodicCheck."""
    tree = ast.parse(path.read_text("utf-8"))
    named: list[ast.expr] = []
    for part in ast.walk(tree):
        is_check = isinstance(part, ast.ClassDef) and "PeriodicCheck" in map(ast.unparse, part.bases)
        for node in ast.walk(part) if is_check else [part]:
            if isinstance(node, ast.Call) and len(node.args) > 1:
                if is_check and ast.unparse(node.func) == "super().__init__":
                    named.append(node.args[0])
                elif getattr(node.args[0], "value", "") == "fault":
                    named.append(node.args[1])
    for name in named:
        if isinstance(name, ast.Constant):
            yield name.value
        elif isinstance(name, ast.Name):
            module = ".".join(("softfinger", *path.relative_to(ROOT).with_suffix("").parts))
            yield getattr(importlib.import_module(module), name.id)


def test_each_published_fault_has_a_row():
    rows = {event for hazard in HAZARDS for event in hazard.events}
    faults = {f"fault {name}" for path in sorted((ROOT / "server").rglob("*.py")) for name in iter_fault_names(path)}
    assert len(faults) >= 9
    guards = {f"guard {name}" for name in {*GUARD_NAMES} - ORDINARY}
    assert rows == faults | guards | {"servo missed", "command heartbeat_missed", FAILED}
    assert f"state {DaemonState.FAULTED}" == FAILED


def test_each_row_has_an_existing_test():
    for hazard in HAZARDS:
        assert hazard.tests, hazard.name
        for test in hazard.tests:
            file, _, name = test.partition("::")
            assert f"\ndef {name}(" in (ROOT / file).read_text("utf-8"), test


def test_measured_reactions_are_within_their_rows():
    content = json.loads(RESULTS_FILE.read_text("utf-8"))
    assert all(row["passed"] == row["of"] for row in content if "test" in row)
    by_name = {hazard.name: hazard for hazard in HAZARDS}
    timed = set()
    for row in (row for row in content if "driver" in row):
        hazard = by_name[row["hazard"]]
        assert row["event"] == "none" or row["event"] in hazard.events, row
        assert row["state"] in set(DaemonState), row
        if row["ticks"] is None:
            assert hazard.within is None, row
        else:
            timed.add(hazard.name)
            assert row["ticks"] <= hazard.within + row.get("handover", 0) + TURN, row
    assert len(timed) >= 7


BY_HAND = {"0 ticks", "0 ticks, 1 of a write"}
"""Reactions without a constant: within the same tick, which tests check for every driver."""


def test_rows_contain_no_literal_numbers():
    (rows,) = [
        node.value
        for node in ast.parse((ROOT / "tools/pages/hazards.py").read_text("utf-8")).body
        if isinstance(node, ast.AnnAssign) and node.target.id == "HAZARDS"
    ]
    texts = [
        literal.value
        for row in rows.elts
        for field in row.args[:5]
        for literal in ast.walk(field)
        if isinstance(literal, ast.Constant) and isinstance(literal.value, str)
    ]
    assert len(texts) > 5 * len(HAZARDS) // 2
    by_hand = {text for text in texts if re.search(r"\d|\b(twice|three|five|half)\b", text)}
    assert by_hand - {".0%", ".1f", ".2f"} == BY_HAND


def test_the_time_for_frozen_poses_follows_the_tests_rig():
    (frozen,) = [hazard for hazard in HAZARDS if hazard.name == "a pose that does not change under a force"]
    assert frozen.within == round(1.2 * FROZEN_S / hazards.TICK_S)


def test_hazards_have_unique_names_and_no_empty_fields():
    assert len({hazard.name for hazard in HAZARDS}) == len(HAZARDS)
    assert all(all(hazard[:5]) for hazard in HAZARDS)


def test_advice_is_for_events_of_the_guard():
    assert set(REMEDIES) == {*GUARD_NAMES} - ORDINARY - {"ramping"}
