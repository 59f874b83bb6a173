"""A process of the daemon without memory, or one that ends while the daemon has no file descriptors, is restarted, and
the daemon's force continues.

The memory limit is the current size, so the next page requested from the system is refused. Recordings and black boxes
are written by threads of the daemon, which has its own row in the fault model.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO
from urllib.error import URLError
from urllib.request import urlopen

import pytest
import zmq
from emulators.serialboard import Board
from helpers.waits import until
from test_kills import find_process, has_exited
from test_process_faults import read_events, stop_daemon
from test_signals import END_S, START_S, ZERO, pressing
from websockets.exceptions import WebSocketException

from softfinger.drivers.samples import RESUME_NS
from softfinger.server.wire.client import subscribe
from softfinger.tools.bench.soak import connect_to_page

pytestmark = pytest.mark.real_time

SETTLE_FRAMES = 110
"""Frames after a pause that may be zero: 100 ms of waiting for a sample and one step of the ramp."""
STALLED = 30
"""Subscribers that do not read: for each the publisher stores 64 bytes of a message, and the message once."""


def limit_memory(pid: int) -> None:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
    most = pages * resource.getpagesize()
    resource.prlimit(pid, resource.RLIMIT_AS, (most, most))


def open_browser(address: str, closing: ExitStack) -> None:
    """Open another browser that reads the page; ignore a refusal by a page that has just ended."""
    with suppress(OSError, WebSocketException):
        closing.enter_context(connect_to_page(address))


def wait_for_process(process: subprocess.Popen[str], kind: str, previous: int = 0) -> int:
    """Wait for the process of a daemon with this role, other than `other`, and return its id."""
    pids: list[int] = []

    def is_running() -> bool:
        pids[:] = [candidate for candidate in [find_process(kind, process.pid)] if candidate not in (None, previous)]
        return bool(pids)

    until(is_running, START_S, f"the {kind}")
    return pids[0]


def find_unexplained_zeroes(board: Board, first: int) -> list[int]:
    """Return the frames after frame `first` that remove the force although no pause of the machine explains it.

    After a pause the driver sends no force until it has a new sample, and the first steps of the ramp round to zero.
    """
    frames, resumed = [], first - SETTLE_FRAMES
    for frame in range(first + 1, len(board.sent)):
        if board.sent_at[frame] - board.sent_at[frame - 1] > RESUME_NS * 1e-9:
            resumed = frame
        if board.sent[frame][2] <= 0 and frame - resumed >= SETTLE_FRAMES:
            frames.append(frame)
    return frames


def test_a_publisher_without_memory_is_restarted(tmp_path: Path) -> None:
    recording = tmp_path / "on.mcap"
    with pressing(tmp_path, "--record", str(recording)) as (board, process):
        first_frame = len(board.sent)
        publisher = wait_for_process(process, "telemetry process")
        with zmq.Context() as context, ExitStack() as closing:
            for _ in range(STALLED):
                stalled = closing.enter_context(context.socket(zmq.SUB))
                stalled.linger, stalled.rcvhwm, stalled.rcvbuf = 0, 1, 1024
                stalled.subscribe(b"")
                stalled.connect(f"ipc://{tmp_path}/t")
            limit_memory(publisher)
            until(lambda: has_exited(publisher), START_S, "the end of the publisher")
        wait_for_process(process, "telemetry process", previous=publisher)
        with subscribe(f"ipc://{tmp_path}/t", timeout_s=START_S) as telemetry:
            first = next(iter(telemetry)).tick
            assert next(sample for sample in telemetry if sample.tick > first + 1500)  # the event is delayed by 1 s
        assert not find_unexplained_zeroes(board, first_frame)
        stderr = stop_daemon(process)
        assert board.force == ZERO
    assert "the telemetry process has ended with code" in stderr
    assert "publisher" in read_events(recording)


@pytest.mark.exhaustive
def test_a_page_without_memory_is_restarted(tmp_path: Path) -> None:
    recording = tmp_path / "on.mcap"
    with pressing(tmp_path, "--view", "--record", str(recording)) as (board, process):
        assert process.stderr is not None
        first_frame = len(board.sent)
        address = next(line for line in process.stderr if line.startswith("http://")).rstrip()
        page = wait_for_process(process, "page")
        with ExitStack() as closing:
            limit_memory(page)
            until(lambda: open_browser(address, closing) or has_exited(page), START_S, "the end of the page")
        ended = next(line for line in process.stderr if "the page has ended" in line)
        assert "restart 1 of 3" in ended
        assert wait_for_process(process, "page", previous=page)
        until(lambda: is_served(address), START_S, "an answer of the page")
        assert not find_unexplained_zeroes(board, first_frame)
        stop_daemon(process)
        assert board.force == ZERO
    assert "page" in read_events(recording)


def is_served(address: str) -> bool:
    """Return True if a server answers with a page."""
    with suppress(URLError), urlopen(address, timeout=60.0) as answer:
        return bool(answer.status == 200)
    return False


def read_line_with(words: str, lines: IO[str]) -> str:
    """Return the next line with these words; no earlier line may report again that a process cannot be started."""
    for line in lines:
        if words in line:
            return line
        assert "cannot be started" not in line
    raise AssertionError(f"no line with {words!r}")


def test_a_process_that_ends_without_free_descriptors_is_restarted(tmp_path: Path) -> None:
    recording = tmp_path / "on.mcap"
    with pressing(tmp_path, "--view", "--record", str(recording)) as (board, process):
        assert process.stderr is not None
        first_frame = len(board.sent)
        hard = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)[1]
        for kind in ("telemetry process", "page"):
            before = wait_for_process(process, kind)
            resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (3, hard))  # open files are not affected
            os.kill(before, signal.SIGKILL)
            read_line_with(f"the {kind} cannot be started: [Errno 24]", process.stderr)
            first = len(board.sent)
            until(lambda first=first: len(board.sent) > first + 1000, END_S, "a thousand forces")
            assert process.poll() is None and find_process(kind, process.pid) in (None, before)
            resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (hard, hard))
            page = wait_for_process(process, kind, previous=before)
        with subscribe(f"ipc://{tmp_path}/t", timeout_s=START_S) as telemetry:
            tick = next(iter(telemetry)).tick
            assert next(sample for sample in telemetry if sample.tick > tick + 1500)  # the event is delayed by 1 s
        os.kill(page, signal.SIGTERM)
        assert "the page has ended" in read_line_with("to see it again: ", process.stderr)
        assert not find_unexplained_zeroes(board, first_frame)
        stderr = stop_daemon(process)
        assert board.force == ZERO
    assert stderr.count("cannot be started") == 0  # logged once each
    assert {"publisher", "page"} <= set(read_events(recording))
