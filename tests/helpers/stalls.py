"""Tests on a machine that may stand still: one that failed meanwhile is run again.

Those that keep real time are marked `real_time`, and run when no other test does, so that they meet this seldom.

A program that only sleeps tells: it wakes each millisecond, and the longest that it overslept is the machine's doing. A
test that fails on a machine that kept time has failed; so has one that fails three times.
"""

from __future__ import annotations

import subprocess
import sys

import pytest
from _pytest.runner import runtestprotocol

TURNS = 3
STALL_S = 0.01
"""Ten ticks, a third of the shortest pause at which a driver withholds the force (drivers/pause.py). A scheduler's turn
among the four programs of such a test takes some 5 ms."""

REPEATED = "repeated_after_stall"

_SLEEPER = """
import select, sys, time
longest, before = 0.0, time.monotonic()
while True:
    asked = bool(select.select([sys.stdin], [], [], 0.001)[0])
    now = time.monotonic()
    longest, before = max(longest, now - before - 0.001), now
    if asked:
        if not sys.stdin.readline():
            break
        told, longest, before = longest, 0.0, time.monotonic()
        print(told, flush=True)
"""


class Sleeper:
    """The program that oversleeps; it ends with the process that started it."""

    def __init__(self) -> None:
        pipe = subprocess.PIPE
        self._program = subprocess.Popen([sys.executable, "-c", _SLEEPER], stdin=pipe, stdout=pipe)

    def longest_s(self) -> float:
        """The longest it overslept since it was last asked, s."""
        assert self._program.stdin is not None and self._program.stdout is not None
        self._program.stdin.write(b"\n")
        self._program.stdin.flush()
        return float(self._program.stdout.readline())

    def close(self) -> None:
        assert self._program.stdin is not None and self._program.stdout is not None
        self._program.stdin.close()
        self._program.wait()
        self._program.stdout.close()


class Patience:
    """The plugin."""

    def __init__(self) -> None:
        self._sleeper: Sleeper | None = None

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool:
        if self._sleeper is None:
            self._sleeper = Sleeper()
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for turn in range(1, TURNS + 1):
            self._sleeper.longest_s()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            stall_s = self._sleeper.longest_s()
            if turn == TURNS or stall_s < STALL_S or not any(report.failed for report in reports):
                break
            why = next(report.longreprtext for report in reports if report.failed).strip().splitlines()[-1]
            item.user_properties.append((REPEATED, f"{item.nodeid}: overslept {stall_s * 1e3:.0f} ms; {why}"))
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        reports = [report for kind in ("passed", "failed") for report in terminalreporter.getreports(kind)]
        told = [text for report in reports for name, text in report.user_properties if name == REPEATED]
        if told:
            terminalreporter.section("repeated, since the machine stood still")
            for line in told:
                terminalreporter.line(line)

    def pytest_unconfigure(self) -> None:
        if self._sleeper is not None:
            self._sleeper.close()
