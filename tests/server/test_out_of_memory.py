"""Processes of a run that are killed, have no memory, or end while the daemon has no file descriptors.

They are restarted, and the daemon's force continues. The memory limit is the current size, so the next page requested
from the system is refused. Recordings and black boxes are written by threads of the daemon, which has its own row in
the fault model. SOFTFINGER_KILLS is the number of kills at random times for `make test-all`, after which no process is
left and the next start works; each needs a start of the program with its page, 4 s.
"""

import itertools
import os
import random
import resource
import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO

import pytest
import zmq
from emulators.serialboard import Board, Cable
from helpers.pages import is_served
from helpers.processes import COMMAND, has_exited, list_children, read_command_line
from helpers.programs import Program, run_program
from helpers.rig_files import write_rig
from helpers.serial_devices import PLACE, RIG
from helpers.waits import eventually, until
from test_process_faults import read_events, stop_daemon
from test_signals import END_S, START_S, ZERO, pressing
from websockets.exceptions import WebSocketException

from softfinger.config.errors import RecordingError
from softfinger.drivers.samples import PAUSE_MIN_NS
from softfinger.proxy.record import AT
from softfinger.server.recording.reader import TickBlock, read_contents
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
    found = eventually(lambda: {find_process(kind, process.pid)} - {None, previous}, START_S)
    assert found, f"no {kind}"
    return int(found.pop())


def find_unexplained_zeroes(board: Board, first: int) -> list[int]:
    """Return the frames after frame `first` that remove the force although no pause of the machine explains it.

    After a pause the driver sends no force until it has a new sample, and the first steps of the ramp round to zero.
    """
    frames, resumed = [], first - SETTLE_FRAMES
    for frame in range(first + 1, len(board.sent)):
        if board.sent_at[frame] - board.sent_at[frame - 1] > PAUSE_MIN_NS * 1e-9:
            resumed = frame
        if board.sent[frame][2] <= 0 and frame - resumed >= SETTLE_FRAMES:
            frames.append(frame)
    return frames


def receive_telemetry(folder: Path) -> None:
    """Wait for ticks until the event of a restart has been published, which is delayed by 1 s."""
    with subscribe(f"ipc://{folder}/t", timeout_s=START_S) as telemetry:
        first = next(iter(telemetry)).tick
        assert next(sample for sample in telemetry if sample.tick > first + 1500)


def end_with_force(process: subprocess.Popen[str], board: Board, first_frame: int) -> str:
    """Assert that the force has continued from a frame on, stop the daemon, and return its log."""
    assert not find_unexplained_zeroes(board, first_frame)
    stderr = stop_daemon(process)
    assert board.force == ZERO
    return stderr


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
        receive_telemetry(tmp_path)
        stderr = end_with_force(process, board, first_frame)
    assert "the telemetry process has ended with code" in stderr
    assert "publisher" in read_events(recording)


@pytest.mark.exhaustive
def test_a_page_without_memory_is_restarted(tmp_path: Path) -> None:
    recording = tmp_path / "on.mcap"
    with pressing(tmp_path, "--view", "--record", str(recording)) as (board, process):
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
        end_with_force(process, board, first_frame)
    assert "page" in read_events(recording)


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
        receive_telemetry(tmp_path)
        os.kill(page, signal.SIGTERM)
        assert "the page has ended" in read_line_with("to see it again: ", process.stderr)
        stderr = end_with_force(process, board, first_frame)
    assert stderr.count("cannot be started") == 0  # logged once each
    assert {"publisher", "page"} <= set(read_events(recording))


KILLS = int(os.environ.get("SOFTFINGER_KILLS", "40"))
VICTIMS = {
    "page": b"\0view\0",
    "telemetry process": b"\0softfinger.server.socket_process\0telemetry\0",
    "commands process": b"\0softfinger.server.socket_process\0commands\0",
    "daemon": b"\0run\0",
}
"""Part of the command line of each process."""
MOMENT_S = 4.0
"""Latest time of a kill after the start: most hit the imports, the opening of the device, or the first ticks."""


def find_process(kind: str, pid: int) -> int | None:
    """Return the process of a run with this role, if it has started."""
    return next((victim for victim in (pid, *list_children(pid)) if VICTIMS[kind] in read_command_line(victim)), None)


def count_readable(path: Path) -> int:
    """Return the number of consecutive ticks in a recording; 0 for a file that ends before its first tick."""
    try:
        parts = [part.records() for part in read_contents(path) if isinstance(part, TickBlock)]
    except RecordingError:
        assert path.stat().st_size < 4096, "a recording with something in it cannot be read"
        return 0
    ticks = [int(tick) for part in parts for tick in part[:, AT.tick]]
    assert ticks == list(range(len(ticks)))
    return len(ticks)


def make_command(tmp_path: Path, rig: Path, *words: str) -> list[str]:
    run = [*COMMAND, "-q", "run", "--realtime", "off", "--rig", str(rig), "--view"]
    return [*run, "--scene", "paper-plane", "--endpoint", f"ipc://{tmp_path}/t", *words]


def run_to_end(tmp_path: Path, rig: Path) -> None:
    """An undisturbed run exits with 0 and leaves no socket, not even one of a previous killed run."""
    run_program(make_command(tmp_path, rig, "--duration", "0.3"), timeout=START_S, check=True)
    assert not [path for path in tmp_path.iterdir() if path.is_socket()]


def kill(process: subprocess.Popen[bytes], kind: str, log_path: Path) -> list[int]:
    """Kill one process of a run, wait until its end is reported, and return all that the daemon had."""
    until(lambda: find_process(kind, process.pid) or process.poll() is not None, START_S, f"there is no {kind}")
    started_pids, victim = list_children(process.pid), find_process(kind, process.pid)
    assert victim is not None, log_path.read_text()
    os.kill(victim, signal.SIGKILL)
    if kind != "daemon":
        words = f"the {kind} has ended"
        until(lambda: words in log_path.read_text() or process.poll() is not None, START_S, f"{words}: not told")
        assert words in log_path.read_text()
    return started_pids + list_children(process.pid)


@pytest.mark.exhaustive
def test_a_kill_at_any_time_leaves_no_process(tmp_path: Path) -> None:
    drawn = random.Random(7)
    board = Board(lambda _: (*PLACE[:2], 0.006))
    recorded = 0
    with Cable(board) as cable:
        rig = write_rig(tmp_path, RIG, path=cable.path, quiet_s=0.1, timeout_s=2.0)
        run_to_end(tmp_path, rig)  # with compiled kernels a run reaches its ticks before most kills
        for number, kind in zip(range(KILLS), itertools.cycle(VICTIMS)):
            recording, log_path = tmp_path / f"{number}.mcap", tmp_path / f"{number}.log"
            with log_path.open("wb") as log, Program(
                make_command(tmp_path, rig, "--record", str(recording)), stderr=log
            ) as process:  # fmt: skip
                try:
                    time.sleep(drawn.uniform(0.0, MOMENT_S))
                    pids = kill(process, kind, log_path)
                    time.sleep(drawn.uniform(0.0, 0.5))  # the daemon restarts the process, or ends with an error
                    pids += list_children(process.pid)
                finally:
                    process.kill()
            until(lambda pids=pids: all(map(has_exited, pids)), END_S, f"kill {number}: a process is left")
            if recording.exists():
                recorded += count_readable(recording)
        run_to_end(tmp_path, rig)
    assert recorded > 0 or len(VICTIMS) >= KILLS, "no kill came after the first tick"
