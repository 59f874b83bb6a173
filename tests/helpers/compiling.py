"""What a run compiles, by file of tests: a line at its end, and the whole list with `--compiled`.

numba tells of each kernel that it compiles, not of one that it finds in the cache. Programs that tests start compile
too: of those the processor's seconds are counted, whatever they spend them on.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, Final

import pytest
from numba.core import event

SHOWN_S: Final = 30.0
"""A file that compiles for longer than this is named at the end of every run; it says at its head why."""
KEY: Final = "compiled"


class Compilations(event.Listener):  # type: ignore[misc]
    """Kernels compiled in this process: how many, and for how long, those within another one's time included in it."""

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0
        self._depth, self._began = 0, 0.0

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._began = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.count += 1
            self.seconds += time.perf_counter() - self._began


class CompilationReport:
    """The plugin; in a parallel run each process sends what it saw with the reports of its tests."""

    def __init__(self) -> None:
        self._seen = Compilations()
        event.register("numba:compile", self._seen)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: Any) -> Iterator[None]:
        report = yield
        if report.when == "teardown":
            started, (count, seconds) = self._started_s(), self._taken()
            report.user_properties.append((KEY, (count, seconds, started - item.stash.get(STARTED, started))))
        return report

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        item.stash[STARTED] = self._started_s()

    def _taken(self) -> tuple[int, float]:
        taken = self._seen.count, self._seen.seconds
        self._seen.count, self._seen.seconds = 0, 0.0
        return taken

    def _started_s(self) -> float:
        """Processor's seconds of programs that have ended."""
        used = os.times()
        return used.children_user + used.children_system

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
        files: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
        for reports in terminalreporter.stats.values():
            for report in reports:
                for name, value in getattr(report, "user_properties", ()):
                    if name == KEY and report.when == "teardown":
                        file = files[report.nodeid.partition("::")[0]]
                        file[:] = [have + more for have, more in zip(file, value, strict=True)]
        if not files:
            return
        count, seconds, started = (sum(column) for column in zip(*files.values(), strict=True))
        every = config.getoption("--compiled")
        terminalreporter.section("kernels compiled")
        for name, (number, own, others) in sorted(files.items(), key=lambda each: -each[1][1] - each[1][2]):
            if (every and (number or others >= 0.05)) or own > SHOWN_S:
                terminalreporter.line(f"{number:5.0f} {own:7.1f} s, and programs {others:6.1f} s  {name}")
        terminalreporter.line(
            f"{count:.0f} kernels in {seconds:.0f} s; programs that tests started took {started:.0f} s of processor"
        )


STARTED: Final = pytest.StashKey[float]()
