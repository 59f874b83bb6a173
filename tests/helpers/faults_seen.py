"""Record the observations of tests with injected faults for the table of the fault model: `--faults-seen FILE`.

A test notes them with `record_property(SEEN, {...})`: hazard, driver, fault; ticks until the device received zero, None
if it keeps a force; event, state, recovery.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

SEEN = "fault_seen"


class FaultsSeen:
    """Pytest plugin: collects the passed tests and their observations."""

    def __init__(self, file: str) -> None:
        self._file = Path(file)
        self._tests: dict[str, dict[str, Any]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        test = self._tests.setdefault(report.nodeid, {"outcome": "passed", "seen": []})
        if report.outcome != "passed":
            test["outcome"] = report.outcome
        if report.when == "call":
            test["seen"] = [value for name, value in report.user_properties if name == SEEN][-1:]

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if not hasattr(session.config, "workerinput"):
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._file.write_text(json.dumps(self._tests, indent=1) + "\n", "utf-8")
