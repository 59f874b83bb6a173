"""Real-time tests on a machine that may stand still: one that failed meanwhile is run again, once it has come to rest.

Programs that only sleep measure that, one on each processor, since a host may stop them one by one: each wakes every
4 ms, and the longest time from one wake-up to the next includes every stall. A test that fails on a machine that kept
time has failed, and so has one that failed three times while the machine stood still. The end of the run names every
test that was run again, and what it said.

Two more ways out, both of them told as skipped. `--put-off FILE` is for a run beside which others compute: a test that
would fail is named in FILE, for a run beside which nothing does, and which alone decides. And where the host of a
virtual machine took the processors for longer than a driver waits for its device (the kernel counts that time), each
time, no test of real time has a result.

What this process does to itself no sleeper sees: looking for garbage among all that numba has made takes a tenth of a
second, in which no thread of a test can answer. That is put off until the test has ended.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time

import pytest
from _pytest.runner import runtestprotocol

TURNS = 3
STALL_S = 0.01
"""From one wake-up to the next: ten ticks, a third of the shortest pause at which a driver withholds the force
(drivers/pause.py). A sleeper sleeps for 4 ms of it, and a scheduler's turn among the four programs of a test takes some
5 ms. A stall of 10 ms is in one such time, whenever it begins."""

REST_S = 0.5
"""How long a machine is to keep time before a test is run again."""
REST_WAIT_S = 15.0
"""How long that is waited for."""

TAKEN_S = 0.1
"""Of the host's doing, in each turn: no test has a result. Drivers give a device up after 0.1 s of silence."""

REPEATED = "repeated_after_stall"
PUT_OFF = "put_off"

_SLEEPER = """
import os, select, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
longest, before = 0.0, time.monotonic()
while True:
    asked = bool(select.select([sys.stdin], [], [], 0.004)[0])
    now = time.monotonic()
    longest, before = max(longest, now - before), now
    if asked:
        if not sys.stdin.readline():
            break
        told, longest, before = longest, 0.0, time.monotonic()
        print(told, flush=True)
"""


class Sleepers:
    """The programs that sleep; they end with the process that started them."""

    def __init__(self) -> None:
        pipe = subprocess.PIPE
        self._programs = [
            subprocess.Popen([sys.executable, "-S", "-c", _SLEEPER, str(processor)], stdin=pipe, stdout=pipe)
            for processor in sorted(os.sched_getaffinity(0))
        ]

    def longest_s(self) -> float:
        """Return the longest time between two wake-ups of a sleeper since the last call, s."""
        for program in self._programs:
            assert program.stdin is not None
            program.stdin.write(b"\n")
            program.stdin.flush()
        told = []
        for program in self._programs:
            assert program.stdout is not None
            told.append(float(program.stdout.readline()))
        return max(told)

    def rest(self) -> None:
        """Wait until the machine has kept time for a while, or for so long that it will not."""
        until = time.monotonic() + REST_WAIT_S
        self.longest_s()
        while time.monotonic() < until:
            time.sleep(REST_S)
            if self.longest_s() < STALL_S:
                return

    def close(self) -> None:
        for program in self._programs:
            assert program.stdin is not None and program.stdout is not None
            program.stdin.close()
            program.wait()
            program.stdout.close()


def taken_s() -> float:
    """The time that the host of a virtual machine has taken from its processors since it started, s (proc_stat(5))."""
    with open("/proc/stat", encoding="ascii") as file:
        return float(file.readline().split()[8]) / os.sysconf("SC_CLK_TCK")


def skip(report: pytest.TestReport, why: str) -> None:
    """Tell a failed test as skipped."""
    path, line, _ = report.location
    report.outcome, report.longrepr = "skipped", (path, (line or 0) + 1, why)


class Patience:
    """The plugin."""

    def __init__(self, put_off: str | None = None) -> None:
        self._sleepers: Sleepers | None = None
        self._put_off = put_off

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
        if not item.get_closest_marker("real_time"):
            return None
        if self._sleepers is None:
            self._sleepers = Sleepers()
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        gc.disable()
        always_taken = True
        for turn in range(1, TURNS + 1):
            self._sleepers.longest_s()
            before_s = taken_s()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            stall_s = self._sleepers.longest_s()
            failed = [report for report in reports if report.failed]
            kept_time = stall_s < STALL_S
            if not failed or (kept_time and not self._put_off):
                break
            always_taken &= min(stall_s, taken_s() - before_s) >= TAKEN_S
            why = failed[0].longreprtext.strip().splitlines()[-1]
            told = (REPEATED, f"{item.nodeid}: overslept {stall_s * 1e3:.0f} ms; {why}")
            if turn < TURNS and not kept_time:
                item.user_properties.append(told)
                self._sleepers.rest()
            else:
                failed[0].user_properties.append(told)
                if self._put_off:
                    failed[0].user_properties.append((PUT_OFF, item.nodeid))
                    why = "put off until no other tests run"
                elif always_taken:
                    why = "no result: the host took the processors in each of three turns"
                else:
                    break
                for report in failed:
                    skip(report, why)
                break
        gc.enable()
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        reports = [report for kind in ("passed", "failed", "skipped") for report in terminalreporter.getreports(kind)]
        told = [said for report in reports for said in getattr(report, "user_properties", ())]
        if repeated := [text for name, text in told if name == REPEATED]:
            terminalreporter.section("repeated")
            for line in repeated:
                terminalreporter.line(str(line))
        if self._put_off:
            with open(self._put_off, "w", encoding="utf-8") as file:
                file.writelines(f"{test}\n" for name, test in told if name == PUT_OFF)

    def pytest_unconfigure(self) -> None:
        if self._sleepers is not None:
            self._sleepers.close()
