"""Sweeps: the same results from every scheduler, and none computed twice."""

import json
import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.tools import sweep
from softfinger.tools.sweep import make_case_key, run_cases

pytestmark = pytest.mark.plain

# 0.1 and pi have no short decimal form; the others are values that encodings lose.
CASES = [{"x": x, "n": n} for n, x in enumerate([0.1, math.pi, 5e-324, -0.0, 1e308, math.inf, 2.0**-1022] * 3)]

computed: list[int] = []
"""Numbers of the cases computed in this process."""


def roots(cases: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    """Something of each case that depends on every bit of it; case 13 takes longest, so blocks end out of order."""
    for case in cases:
        computed.append(int(case["n"]))
        if case["n"] == 13:
            time.sleep(0.05)
    return [{"root": math.sqrt(abs(case["x"])), "half": case["x"] / 2, "n": case["n"]} for case in cases]


def failing(cases: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    if any(case["n"] == 11 for case in cases):
        raise ArithmeticError("case 11")
    return roots(cases)


failing.__qualname__ = roots.__qualname__  # so that they share their results


def bits(results: list[dict[str, float]]) -> list[list[str]]:
    return [[float(value).hex() for value in result.values()] for result in results]


@pytest.fixture(autouse=True)
def forget() -> None:
    computed.clear()


def test_results_are_in_case_order_for_every_block_size() -> None:
    expected = bits(roots(CASES))
    for block in (None, 1, 5, 1000):
        assert bits(run_cases(roots, CASES, label="test", block=block)) == expected


def test_equal_cases_are_computed_once() -> None:
    assert bits(run_cases(roots, [CASES[0]] * 3, label="test")) == bits(roots([CASES[0]]) * 3)
    assert computed == [0, 0]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    where = tmp_path / "scheduler.json"
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    common = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    worker = f"worker --scheduler-file {where} --nthreads 1 --no-dashboard --no-nanny --local-directory {tmp_path}"
    words = [f"scheduler --host 127.0.0.1 --port 0 --no-dashboard --scheduler-file {where}", worker, worker]
    processes = [
        subprocess.Popen([*common, *some.split()], env={**os.environ, "PYTHONPATH": path}, **quiet) for some in words
    ]
    try:
        deadline = time.monotonic() + 60.0
        while not where.exists() or not where.stat().st_size:
            assert time.monotonic() < deadline and processes[0].poll() is None, "the scheduler did not start"
            time.sleep(0.05)
        address = json.loads(where.read_text())["address"]
        from distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60.0)
        yield address, processes[0]
    finally:
        for process in processes:  # killed: a worker may wait for its scheduler without end
            process.kill()
            process.wait()


def test_a_dask_scheduler_resumes_with_the_same_bits(cluster, tmp_path, monkeypatch):
    """Half of the cases by threads into a file, the others by workers; then the scheduler is killed during a longer
    run."""
    scheduler, process = cluster
    results = tmp_path / "cases.mcap"
    run_cases(roots, CASES[::2], label="test", results=results)
    computed.clear()
    values = run_cases(roots, CASES, label="test", results=results, scheduler=scheduler, block=2)
    assert not computed, "computed here, not by the workers"
    assert bits(values) == bits(roots(CASES))
    computed.clear()
    assert bits(run_cases(roots, CASES, label="test", results=results)) == bits(values)
    assert not computed

    monkeypatch.setattr(sweep, "CONNECT_S", 1.0)
    threading.Timer(1.0, process.kill).start()
    with pytest.raises(
        ConfigError, match=f"--scheduler {scheduler}: lost during a computation.*--results FILE continues"
    ):
        run_cases(roots, [{"x": 2.0, "n": 13, "number": n} for n in range(200)], label="t", scheduler=scheduler)


def test_finished_blocks_outlive_an_error(tmp_path: Path) -> None:
    results = tmp_path / "cases.mcap"
    with pytest.raises(ArithmeticError, match="case 11"):
        run_cases(failing, CASES, label="test", results=results, block=3)
    size = len(results.read_bytes())
    computed.clear()
    assert bits(run_cases(roots, CASES, label="test", results=results, block=3)) == bits(roots(CASES))
    first = computed[: -len(CASES)]
    assert {9, 10, 11} <= set(first) < set(range(len(CASES))) and len(results.read_bytes()) > size


@pytest.mark.parametrize("damage", ["cut in a row", "cut at the end", "a bit flipped"])
def test_a_damaged_end_is_dropped_with_a_warning(damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    results = tmp_path / "cases.mcap"
    run_cases(roots, CASES, label="test", results=results, block=1)
    data = bytearray(results.read_bytes())
    middle = data.index(b"result", len(data) // 2)
    if damage == "a bit flipped":
        data[middle + 12] ^= 1
    results.write_bytes(data[: {"cut in a row": middle, "cut at the end": len(data) - 9}.get(damage, len(data))])
    computed.clear()
    with caplog.at_level(logging.WARNING):
        values = run_cases(roots, CASES, label="test", results=results)
    count = len(computed)
    assert bits(values) == bits(roots(CASES))
    assert "truncated or damaged" in caplog.text
    assert count == 0 if damage == "cut at the end" else 0 < count < len(CASES)
    caplog.clear()
    computed.clear()
    run_cases(roots, CASES, label="test", results=results)
    assert not computed and not caplog.text


def test_another_file_is_not_overwritten(tmp_path: Path) -> None:
    results = tmp_path / "notes.txt"
    results.write_text("not a sweep")
    with pytest.raises(RecordingError, match=r"notes\.txt: not a file of sweep results.*name another"):
        run_cases(roots, CASES, label="test", results=results)
    assert results.read_text() == "not a sweep"


def test_two_runs_do_not_share_a_file(tmp_path: Path) -> None:
    results = tmp_path / "cases.mcap"

    def nested(cases: Sequence[dict[str, float]]) -> list[dict[str, float]]:
        with pytest.raises(RecordingError, match="another run is writing to it"):
            run_cases(roots, CASES, label="inner", results=results)
        return roots(cases)

    assert len(run_cases(nested, CASES[:1], label="outer", results=results)) == 1


def test_a_file_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"cases\.mcap: cannot be used for results: No such file or directory"):
        run_cases(roots, CASES, label="test", results=tmp_path / "nowhere" / "cases.mcap")


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [
        ("cluster", "must be 'local' or the address of a dask scheduler such as tcp://"),
        ("tcp://127.0.0.1:9", "no dask scheduler there"),  # the discard service, on no machine of today
    ],
)
def test_a_wrong_scheduler_is_reported(scheduler: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "CONNECT_S", 0.3)
    with pytest.raises(ConfigError, match=f"--scheduler {scheduler}: {message}"):
        run_cases(roots, CASES, label="test", scheduler=scheduler)


def test_a_worker_of_another_version_is_refused() -> None:
    with pytest.raises(ConfigError, match="another version of softfinger: its sources have the hash"):
        sweep._compute("0" * 64, roots, CASES)
    assert not computed


def test_keys_differ_by_case_function_and_version(monkeypatch: pytest.MonkeyPatch) -> None:
    key = make_case_key(roots, {"x": 0.1, "n": 1})
    assert make_case_key(roots, {"n": 1, "x": 0.1}) == key
    others = [make_case_key(roots, {"x": math.nextafter(0.1, 1.0), "n": 1}), make_case_key(bits, {"x": 0.1, "n": 1})]
    monkeypatch.setattr(sweep, "SOURCE_HASH", "0" * 64)
    assert len({key, *others, make_case_key(roots, {"x": 0.1, "n": 1})}) == 4
