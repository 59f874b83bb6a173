"""A test that failed is repeated where the machine stood still, and nowhere else."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from helpers.stalls import Sleepers

pytest_plugins = ["pytester"]

SECOND_TIME_LUCKY = """
import pytest

turns = []

@pytest.mark.real_time
def test_luck():
    turns.append(1)
    assert len(turns) == 2
"""


NO_LUCK = """
import pytest

@pytest.mark.real_time
def test_luck():
    assert False, "one tick was late"
"""


def run(pytester: pytest.Pytester, overslept_s: float, test: str = SECOND_TIME_LUCKY) -> pytest.RunResult:
    """A test on a machine that oversleeps so long each time."""
    pytester.makeconftest(f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from helpers import stalls
        stalls.REST_WAIT_S = 0.0
        stalls.Sleepers.longest_s = lambda self: {overslept_s}
        def pytest_configure(config):
            config.pluginmanager.register(stalls.Patience())
    """)
    pytester.makepyfile(test)
    return pytester.runpytest_subprocess("-p", "no:cacheprovider")


def test_repeated_where_the_machine_stood_still(pytester: pytest.Pytester) -> None:
    """And the end of the run says so, with what had failed."""
    result = run(pytester, 0.05)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["*repeated, since the machine stood still*", "*::test_luck: overslept 50 ms; *"])


def test_failed_where_it_stood_still_each_time(pytester: pytest.Pytester) -> None:
    """Three times is a failure, whatever the machine did, and the end of the run has what it said each time."""
    result = run(pytester, 0.05, NO_LUCK)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*repeated, *", *["*::test_luck: overslept 50 ms; *"] * 3])
    run(pytester, 0.001, NO_LUCK).assert_outcomes(failed=1)


def test_failed_where_it_kept_time(pytester: pytest.Pytester) -> None:
    """A test that passes on the second try has failed; so has one that does not wait for the clock."""
    run(pytester, 0.001).assert_outcomes(failed=1)
    run(pytester, 0.05, SECOND_TIME_LUCKY.replace("@pytest.mark.real_time", "")).assert_outcomes(failed=1)


def test_no_garbage_is_looked_for_meanwhile(pytester: pytest.Pytester) -> None:
    """While a test that keeps real time runs, and in no other."""
    test = """
        import gc, pytest

        @pytest.mark.real_time
        def test_one():
            assert not gc.isenabled()

        def test_other():
            assert gc.isenabled()
    """
    run(pytester, 0.001, test).assert_outcomes(passed=2)


def test_a_stall_of_one_processor_is_told() -> None:
    """A program that is stopped for 50 ms oversleeps by as much, on whichever processor it is."""
    sleepers = Sleepers()
    try:
        sleepers.longest_s()  # they are up
        assert [os.sched_getaffinity(program.pid) for program in sleepers._programs] == [
            {cpu} for cpu in sorted(os.sched_getaffinity(0))
        ]
        for program in sleepers._programs:
            sleepers.longest_s()
            os.kill(program.pid, signal.SIGSTOP)
            time.sleep(0.05)
            os.kill(program.pid, signal.SIGCONT)
            assert sleepers.longest_s() > 0.04
    finally:
        sleepers.close()


def test_a_machine_that_keeps_time_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """And for no longer: the second half-second that is asked about is quiet."""
    sleepers, overslept = Sleepers(), iter([0.0, 0.05, 0.001, 0.05])
    try:
        monkeypatch.setattr(sleepers, "longest_s", lambda: next(overslept))
        sleepers.rest()
        assert next(overslept) == 0.05
    finally:
        sleepers.close()
