"""A test that failed is repeated where the machine stood still, and nowhere else."""

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


def run(
    pytester: pytest.Pytester,
    overslept_s: float,
    test: str = SECOND_TIME_LUCKY,
    taken_s: float = 0.0,
    put_off: str = "",
) -> pytest.RunResult:
    """A test on a machine that oversleeps so long each time, while its host takes so much."""
    pytester.makeconftest(f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from helpers import stalls
        stalls.REST_WAIT_S = 0.0
        stalls.Sleepers.longest_s = lambda self: {overslept_s}
        taken = iter(range(100))
        stalls.taken_s = lambda: next(taken) * {taken_s}
        def pytest_configure(config):
            config.pluginmanager.register(stalls.Patience({put_off!r}))
    """)
    pytester.makepyfile(test)
    return pytester.runpytest_subprocess("-p", "no:cacheprovider")


@pytest.fixture(autouse=True)
def _no_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """The inner runs load no plugins: importing the installed ones takes longer than the tests."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")


def test_repeated_where_the_machine_stood_still(pytester: pytest.Pytester) -> None:
    result = run(pytester, 0.05)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["*= repeated =*", "*::test_luck: overslept 50 ms; *"])


def test_failed_where_it_stood_still_each_time(pytester: pytest.Pytester) -> None:
    result = run(pytester, 0.05, NO_LUCK)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*= repeated =*", *["*::test_luck: overslept 50 ms; *"] * 3])
    run(pytester, 0.001, NO_LUCK).assert_outcomes(failed=1)


def test_no_result_where_the_host_took_the_processors(pytester: pytest.Pytester) -> None:
    run(pytester, 0.2, NO_LUCK, taken_s=0.2).assert_outcomes(skipped=1)
    for overslept_s, of_it_taken_s in ((0.2, 0.05), (0.05, 0.2), (0.001, 0.2)):
        run(pytester, overslept_s, NO_LUCK, of_it_taken_s).assert_outcomes(failed=1)


def test_a_failed_test_is_put_off_while_other_parts_run(pytester: pytest.Pytester) -> None:
    later = pytester.path / "later"
    for overslept_s, times in ((0.05, 3), (0.001, 1)):
        result = run(pytester, overslept_s, NO_LUCK, put_off=str(later))
        result.assert_outcomes(skipped=1)
        assert later.read_text() == "test_a_failed_test_is_put_off_while_other_parts_run.py::test_luck\n"
        assert result.stdout.str().count("::test_luck: overslept") == times
    run(pytester, 0.05, put_off=str(later)).assert_outcomes(passed=1)
    assert later.read_text() == ""


def test_a_test_without_stalls_fails(pytester: pytest.Pytester) -> None:
    run(pytester, 0.001).assert_outcomes(failed=1)
    run(pytester, 0.05, SECOND_TIME_LUCKY.replace("@pytest.mark.real_time", "")).assert_outcomes(failed=1)


def test_a_stall_of_one_processor_is_detected() -> None:
    sleepers = Sleepers()
    try:
        sleepers.longest_s()  # they are up
        own = [os.sched_getaffinity(program.pid) for program in sleepers._programs]
        assert own == [{cpu} for cpu in sorted(os.sched_getaffinity(0))]
        for program in sleepers._programs:
            sleepers.longest_s()
            os.kill(program.pid, signal.SIGSTOP)
            time.sleep(0.05)
            os.kill(program.pid, signal.SIGCONT)
            assert sleepers.longest_s() > 0.04
    finally:
        sleepers.close()
