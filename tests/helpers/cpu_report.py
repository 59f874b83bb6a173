"""Write the CPU seconds of each test to a file, from which tests/run.py makes a table.

CPU seconds do not depend on other processes, so they can be compared between runs. Three parts are counted: the test's
process, numba's compilation in it, and the programs that the test started and waited for.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
from numba.core import event

PROPERTY: Final = "cpu_seconds"


class CpuSeconds(NamedTuple):
    """CPU time in seconds: of this process, of its compilations, and of ended child processes."""

    process: float
    compile: float
    programs: float

    def __sub__(self, before: CpuSeconds) -> CpuSeconds:
        return CpuSeconds(*(late - early for late, early in zip(self, before, strict=True)))


class CompileTimer(event.Listener):
    """CPU time of compilations in this process. A kernel compiled within another one counts once."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth, self._start = 0, 0.0

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._start = time.process_time()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.process_time() - self._start


class CpuReport:
    """Pytest plugin. In a parallel run each worker sends its figures with the reports of its tests."""

    def __init__(self, file: str) -> None:
        self._file = Path(file)
        self._compile = CompileTimer()
        self._start: dict[str, CpuSeconds] = {}
        self._tests: dict[str, list[float]] = {}
        event.register("numba:compile", self._compile)

    def _read(self) -> CpuSeconds:
        used = os.times()
        return CpuSeconds(used.user + used.system, self._compile.seconds, used.children_user + used.children_system)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        self._start[item.nodeid] = self._read()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: Any) -> Iterator[None]:
        report = yield
        if report.when == "teardown" and item.nodeid in self._start:
            seconds = self._read() - self._start.pop(item.nodeid)
            report.user_properties.append((PROPERTY, tuple(seconds)))  # execnet cannot send named tuples
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            for name, value in report.user_properties:
                if name == PROPERTY:
                    self._tests[report.nodeid] = list(value)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if not hasattr(session.config, "workerinput"):
            self._file.write_text(json.dumps(self._tests), "utf-8")
