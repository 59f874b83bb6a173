"""A test that failed is repeated where the machine stood still, and nowhere else."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from helpers.stalls import Sleeper

pytest_plugins = ["pytester"]

SECOND_TIME_LUCKY = """
turns = []

def test_luck():
    turns.append(1)
    assert len(turns) == 2
"""


NO_LUCK = """
import pytest

@pytest.mark.{mark}
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
        stalls.Sleeper.longest_s = lambda self: {overslept_s}
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


def test_skipped_where_it_stood_still_each_time(pytester: pytest.Pytester) -> None:
    """One that keeps real time, and the end of the run has what it said each time; another has failed."""
    result = run(pytester, 0.05, NO_LUCK.format(mark="real_time"))
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["*repeated, *", *["*::test_luck: overslept 50 ms; *"] * 3, "*1 skipped*"])
    run(pytester, 0.05, NO_LUCK.format(mark="other")).assert_outcomes(failed=1)
    run(pytester, 0.001, NO_LUCK.format(mark="real_time")).assert_outcomes(failed=1)


def test_failed_where_it_kept_time(pytester: pytest.Pytester) -> None:
    """A test that passes on the second try has failed."""
    run(pytester, 0.001).assert_outcomes(failed=1)


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


def test_sleeper_tells_a_stall() -> None:
    """A program that is stopped for 50 ms oversleeps by as much."""
    sleeper = Sleeper()
    try:
        sleeper.longest_s()
        os.kill(sleeper._program.pid, signal.SIGSTOP)
        time.sleep(0.05)
        os.kill(sleeper._program.pid, signal.SIGCONT)
        assert sleeper.longest_s() > 0.04
    finally:
        sleeper.close()


def test_sleeper_waits_for_a_machine_that_keeps_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """And for no longer: the second half-second that it asks about is quiet."""
    sleeper, overslept = Sleeper(), iter([0.0, 0.05, 0.001, 0.05])
    try:
        monkeypatch.setattr(sleeper, "longest_s", lambda: next(overslept))
        sleeper.rest()
        assert next(overslept) == 0.05
    finally:
        sleeper.close()
