"""Repeat real-time tests that failed while the machine did not keep time.

Programs that only sleep measure this, one on each processor, since a hypervisor may stop processors separately. Each
wakes every 4 ms, and the longest time between two wake-ups includes every stall. A test fails if the machine kept time,
or if it failed three times with stalls. The end of the run lists every repeated test with its error.

In two cases a failed test is reported as skipped. With `--put-off FILE`, for runs on a loaded machine, the test is
named in FILE and must be repeated on an idle one. And if the hypervisor took the processors for longer than a driver
waits for its device in each attempt (the kernel counts this time), real-time tests have no result.

A garbage collection over numba's objects takes 0.1 s in this process, in which no thread of a test can answer and which
the sleepers do not see. It is delayed until the end of the test.
"""

import gc
import os
import subprocess
import sys
import time

import pytest
from _pytest.runner import runtestprotocol

TURNS = 3
STALL_S = 0.01
"""Time between two wake-ups: ten ticks, a third of the shortest pause after which a driver withholds the force
(drivers/samples.py). A sleeper sleeps for 4 ms of it, and a scheduling round of a test's four programs takes about 5
ms. Every stall of 10 ms falls into one such interval."""

REST_S = 0.5
"""Time for which a machine must be free of stalls before a test is repeated."""
REST_WAIT_S = 15.0
"""Longest wait for that."""

TAKEN_S = 0.1
"""Time taken by the hypervisor in each attempt, above which a test has no result. Drivers give up a device after 0.1 s
of silence."""

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
    """The sleeping programs; they end with the process that started them."""

    def __init__(self) -> None:
        pipe = subprocess.PIPE
        self._programs = [
            subprocess.Popen([sys.executable, "-S", "-c", _SLEEPER, str(processor)], stdin=pipe, stdout=pipe)
            for processor in sorted(os.sched_getaffinity(0))
        ]

    def longest_s(self) -> float:
        """Return the longest time between two wake-ups of a sleeper since the last call, s."""
        for program in self._programs:
            program.stdin.write(b"\n")
            program.stdin.flush()
        return max(float(program.stdout.readline()) for program in self._programs)

    def rest(self) -> None:
        """Wait until the machine has been free of stalls for REST_S, at most REST_WAIT_S."""
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
    """Return the time that the hypervisor has taken from the processors since the start, s (proc_stat(5))."""
    with open("/proc/stat", encoding="ascii") as file:
        return float(file.readline().split()[8]) / os.sysconf("SC_CLK_TCK")


def skip(report: pytest.TestReport, why: str) -> None:
    path, line, _ = report.location
    report.outcome, report.longrepr = "skipped", (path, (line or 0) + 1, why)


class Patience:
    """The pytest plugin."""

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
            note = (REPEATED, f"{item.nodeid}: overslept {stall_s * 1e3:.0f} ms; {why}")
            if turn < TURNS and not kept_time:
                item.user_properties.append(note)
                self._sleepers.rest()
            else:
                failed[0].user_properties.append(note)
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
        notes = [note for report in reports for note in getattr(report, "user_properties", ())]
        if repeated := [text for name, text in notes if name == REPEATED]:
            terminalreporter.section("repeated")
            for line in repeated:
                terminalreporter.line(str(line))
        if self._put_off:
            with open(self._put_off, "w", encoding="utf-8") as file:
                file.writelines(f"{test}\n" for name, test in notes if name == PUT_OFF)

    def pytest_unconfigure(self) -> None:
        if self._sleepers is not None:
            self._sleepers.close()
