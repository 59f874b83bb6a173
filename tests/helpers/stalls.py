"""Tests on a machine that may stand still: one that failed meanwhile is run again, once the machine has come to rest.

Those that keep real time are marked `real_time`, and run when no other test does, so that they meet this seldom.

A program that only sleeps tells: it wakes each millisecond, and the longest that it overslept is the machine's doing. A
test that fails on a machine that kept time has failed. Of one that failed three times while the machine stood still,
those marked `real_time` are skipped, named and with what they said, for a clock that stops proves nothing about a
program that keeps time; every other has failed.

What this process does to itself no sleeper sees: looking for garbage among all that numba has made takes a tenth of a
second, in which no thread of a test can answer. That is put off until the test has ended.
"""

from __future__ import annotations

import gc
import subprocess
import sys
import time

import pytest
from _pytest.runner import runtestprotocol

TURNS = 3
STALL_S = 0.01
"""Ten ticks, a third of the shortest pause at which a driver withholds the force (drivers/pause.py). A scheduler's turn
among the four programs of such a test takes some 5 ms."""

REST_S = 0.5
"""How long a machine is to keep time before a test is run again."""
REST_WAIT_S = 15.0
"""How long that is waited for."""

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

    def rest(self) -> None:
        """Wait until the machine has kept time for a while, or for so long that it will not."""
        until = time.monotonic() + REST_WAIT_S
        self.longest_s()
        while time.monotonic() < until:
            time.sleep(REST_S)
            if self.longest_s() < STALL_S:
                return

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
        if item.get_closest_marker("real_time"):
            gc.disable()
        for turn in range(1, TURNS + 1):
            self._sleeper.longest_s()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            stall_s = self._sleeper.longest_s()
            failed = [report for report in reports if report.failed]
            if not failed or stall_s < STALL_S:
                break
            why = failed[0].longreprtext.strip().splitlines()[-1]
            told = (REPEATED, f"{item.nodeid}: overslept {stall_s * 1e3:.0f} ms; {why}")
            if turn < TURNS:
                item.user_properties.append(told)
                self._sleeper.rest()
            elif item.get_closest_marker("real_time"):
                for report in failed:
                    report.user_properties.append(told)
                    self._skip(item, report)
        gc.enable()
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def _skip(self, item: pytest.Item, report: pytest.TestReport) -> None:
        path, line, _ = item.location
        report.outcome = "skipped"
        report.longrepr = (
            path,
            line or 0,
            f"the machine stood still each of {TURNS} times; it said: {report.longreprtext}",
        )

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        reports = [report for kind in ("passed", "failed", "skipped") for report in terminalreporter.getreports(kind)]
        told = [text for report in reports for name, text in report.user_properties if name == REPEATED]
        if told:
            terminalreporter.section("repeated, since the machine stood still")
            for line in told:
                terminalreporter.line(line)

    def pytest_unconfigure(self) -> None:
        if self._sleeper is not None:
            self._sleeper.close()
