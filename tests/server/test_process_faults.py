"""Faults of the machine: processes sleep, are killed or have no memory or file descriptors; clocks are set; no network.

Processes are restarted, and the daemon's force continues. The memory limit is the current size, so the next page that
is requested from the system is refused. Recordings and black boxes are written by threads of the daemon, which has its
own row in the fault model. SOFTFINGER_KILLS is the number of kills at random times for `make test-all`, after which no
process is left and the next start works; each needs a start of the program with its page, 4 s.
"""

import contextlib
import itertools
import json
import os
import random
import resource
import select
import shutil
import signal
import stat
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO

import pytest
import zmq
from emulators.serialboard import Board, Cable
from faults_seen import SEEN
from helpers.c_stub import COMPILER, NO_COMPILER, compile_stub
from helpers.daemons import make_daemon
from helpers.pages import is_served
from helpers.processes import COMMAND, find_child, has_exited, list_children, read_command_line, read_state
from helpers.programs import Program, run_program
from helpers.rig_files import write_rig
from helpers.serial_devices import PLACE, RIG, at_rest
from helpers.waits import WAIT_S, eventually, until
from test_signals import END_S, FORCE_N, START_S, ZERO, pressing
from websockets.exceptions import WebSocketException

from softfinger.config.errors import RecordingError
from softfinger.config.schema import find_runtime_folder
from softfinger.drivers.samples import PAUSE_MIN_NS
from softfinger.proxy.record import AT
from softfinger.server.loop.guard import RAMPING
from softfinger.server.recording.reader import Event, TickBlock, read_contents
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.endpoint import listen
from softfinger.tools.bench.soak import connect_to_page

pytestmark = pytest.mark.real_time

Note = Callable[[str, object], None]
CLOCK = Path(__file__).parents[1] / "stubs" / "clock.c"
SLEPT_S = 0.6
"""Longer than the 0.25 s after which a loop counts as stalled, shorter than this rig waits for its board."""
RAMP_TICKS = 500
"""Ramp of the rig."""


def read_events(path: Path) -> list[str]:
    """Return the names of the events of a recording, in which no tick may be missing."""
    parts = list(read_contents(path))
    ticks = [int(row) for part in parts if isinstance(part, TickBlock) for row in part.records()[:, AT.tick]]
    assert ticks == list(range(len(ticks)))
    return [part.event["name"] for part in parts if isinstance(part, Event)]


def note(record_property: Note, fault: str, ticks: int | None, event: str, recovery: str, **more: str) -> None:
    """Record a reaction of a daemon with a serial board for the fault model."""
    reaction = {"driver": "serial", "fault": fault, "ticks": ticks, "event": event, "state": "armed"}
    record_property(SEEN, more | reaction | {"recovery": recovery})


def stop_daemon(process: subprocess.Popen[str]) -> str:
    """Stop a daemon by SIGINT; return its stderr."""
    process.send_signal(signal.SIGINT)
    stderr = process.communicate(timeout=END_S)[1]
    assert process.returncode == 0, stderr
    return stderr


def fill_stderr(process: subprocess.Popen[str]) -> None:
    """Fill the pipe of a program's standard error, which the test reads no more."""
    pipe = os.open(f"/proc/{process.pid}/fd/2", os.O_WRONLY | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(pipe, bytes(select.PIPE_BUF))
    os.close(pipe)


def test_processes_that_sleep_wake_with_zero_force(tmp_path: Path, record_property: Note) -> None:
    recording = tmp_path / "slept.mcap"
    with pressing(tmp_path, "--record", str(recording)) as (board, process):
        everyone = [*list_children(process.pid), process.pid]
        for member in everyone:
            os.kill(member, signal.SIGSTOP)
        until(lambda: all(read_state(member) == "T" for member in everyone), END_S, "the stop")
        until(lambda: at_rest(lambda: len(board.sent)), END_S, "the end of frames in transit")
        count = len(board.sent)
        time.sleep(SLEPT_S)
        assert len(board.sent) == count
        for member in everyone:
            os.kill(member, signal.SIGCONT)
        until(lambda: len(board.sent) > count + RAMP_TICKS // 5, END_S, "forces anew")
        before, forces = board.sent[count - 1][2], [frame[2] for frame in board.sent[count:]]
        first = next(place for place, force in enumerate(forces) if force <= before * 2 / RAMP_TICKS)
        assert first <= 1, "more than the tick that was under way had a force"
        # Without a wall the hand gets 4 mm deep, and overshoots to at most twice that, a fiftieth of 8 N.
        assert max(forces[first : first + RAMP_TICKS // 50]) < before / 2
        stop_daemon(process)
    assert "ramping" in read_events(recording)
    note(record_property, "every process is stopped for 0.6 s", first, "guard ramping", "the ramp")


def test_a_stopped_publisher_delays_nothing(tmp_path: Path, record_property: Note) -> None:
    recording = tmp_path / "on.mcap"
    with pressing(tmp_path, "--record", str(recording)) as (board, process):
        publisher = find_child(process.pid, b"socket_process\0telemetry")
        os.kill(publisher, signal.SIGSTOP)
        until(lambda: read_state(publisher) == "T", END_S, "the stop")
        count = len(board.sent)
        until(lambda: len(board.sent) > count + 1000, END_S, "a thousand forces")
        forces = [frame[2] for frame in board.sent[count : count + 1000]]
        os.kill(publisher, signal.SIGCONT)
        with subscribe(f"ipc://{tmp_path}/t", timeout_s=END_S) as telemetry:
            first = next(iter(telemetry)).tick
            assert next(sample for sample in telemetry if sample.tick > first + 100)
        fill_stderr(process)
        os.kill(find_child(process.pid, b"socket_process\0commands"), signal.SIGKILL)
        with Control(f"ipc://{tmp_path}/t.commands", END_S) as control:
            assert control.disarm().armed is False
            until(lambda: board.force == ZERO, END_S, "the zero")
            assert control.arm().armed
        until(lambda: board.force[2] > FORCE_N, END_S, "the force")
        process.send_signal(signal.SIGTERM)
        assert process.wait(END_S) == 0
        until(lambda: board.force == ZERO, END_S, "the zero")
    assert min(forces) > 0.0
    read_events(recording)
    hazard = "a publisher that hangs, a lost network"  # it is a test of another one, too
    note(record_property, "the publisher is stopped for a second", None, "none", "none needed", hazard=hazard)


def make_clocks(folder: Path) -> tuple[dict[str, str], Callable[[int, int], None]]:
    """Return the environment with clocks from tests/stubs/clock.c, and a function that sets both."""
    library, file = compile_stub(CLOCK, folder / "clock.so"), folder / "clocks"
    file.write_bytes(bytes(16))

    def set_clocks(ahead_s: int, suspended_s: int) -> None:
        with file.open("r+b") as numbers:
            numbers.write(struct.pack("=qq", ahead_s, suspended_s))

    return {"LD_PRELOAD": str(library), "SET_CLOCK": str(file)}, set_clocks


@pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)
@pytest.mark.parametrize("slept_s", [pytest.param(1, marks=pytest.mark.exhaustive), 3600])
def test_a_machine_that_was_suspended_wakes_with_zero_force(slept_s, tmp_path, record_property):
    """Time stops during a suspension, so there is no gap, but the force ramps from zero in the tick that wakes."""
    recording = tmp_path / "slept.mcap"
    environment, set_clocks = make_clocks(tmp_path)
    with pressing(tmp_path, "--record", str(recording), environment=environment) as (board, process):
        count = len(board.sent) + RAMP_TICKS
        until(lambda: len(board.sent) >= count, END_S, "the end of the initial ramp")
        before = max(frame[2] for frame in board.sent[count - RAMP_TICKS : count])  # some are in a ramp after a stall
        set_clocks(0, slept_s)
        until(lambda: len(board.sent) > count + RAMP_TICKS // 5, END_S, "forces after it")
        forces = [frame[2] for frame in board.sent[count:]]
        first = next((place for place, force in enumerate(forces) if force <= before * 2 / RAMP_TICKS), None)
        assert first is not None, "the force was carried over"
        assert max(forces[first : first + RAMP_TICKS // 50]) < before / 2  # as above
        stop_daemon(process)
    rows = [row for part in read_contents(recording) if isinstance(part, TickBlock) for row in part.records()]
    assert [int(row[AT.tick]) for row in rows] == list(range(len(rows)))
    long = [row for row in rows if row[AT.dt] > 0.9]
    assert len(long) == 1 and int(long[0][AT.servo_guard]) & RAMPING  # a suspension counts as one second
    note(record_property, f"the machine is suspended for {slept_s} s", 0, "guard ramping", "the ramp")


@pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)
@pytest.mark.exhaustive
@pytest.mark.parametrize("jump_s", [-3600, 3600])
def test_a_clock_that_is_set_puts_nothing_out_of_order(jump_s: int, tmp_path: Path, record_property: Note) -> None:
    recording = tmp_path / "set.mcap"
    environment, set_clocks = make_clocks(tmp_path)
    with pressing(tmp_path, "--record", str(recording), environment=environment) as (board, process):
        with Control(f"ipc://{tmp_path}/t.commands", START_S) as control:
            control.mark("before")
            count = len(board.sent)
            set_clocks(jump_s, 0)
            until(lambda: len(board.sent) > count + 500, END_S, "forces after it")
            control.mark("after")
        forces = [frame[2] for frame in board.sent[count : count + 500]]
        stop_daemon(process)
    assert min(forces) > 0.0
    parts = list(read_contents(recording))
    rows = [row for part in parts if isinstance(part, TickBlock) for row in part.records()]
    times = {int(row[AT.tick]): row[AT.timestamp] for row in rows}
    assert list(times) == list(range(len(times)))
    assert all(later > earlier for earlier, later in zip(list(times.values()), list(times.values())[1:], strict=False))
    events = [part.event for part in parts if isinstance(part, Event)]
    marks = {event["label"]: event for event in events if event["name"] == "mark"}
    for mark in marks.values():
        # An event arrives within a few ticks; the limit excludes an hour between them.
        assert abs(mark["timestamp"] - times[mark["tick"]]) < 5.0
    assert marks["before"]["timestamp"] < marks["after"]["timestamp"]
    note(record_property, f"the clock is set by {jump_s} s", None, "none", "none needed")


NETWORK = """
import json, subprocess, sys
from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.services.records import Sink
from softfinger.server.wire.client import subscribe

def link(way):
    subprocess.run(["ip", "link", "set", "lo", way], check=True)

link("up")
ticks, lost = [], []
rig = load_rig("replay", {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"})
sink = Sink("ticks", lambda records, drops: (ticks.extend(records[:, AT.tick].tolist()), lost.append(drops)))
with Daemon(rig, load_scene("paper-plane"), sinks=[sink]) as daemon:
    daemon.start()
    with subscribe(daemon.publisher.endpoint, timeout_s=60.0) as telemetry:
        heard = iter(telemetry)
        before = next(heard).tick
        link("down")
        away = daemon.servo.ticks
        while daemon.servo.ticks < away + 1000:
            pass
        link("up")
        back = daemon.servo.ticks
        after = next(sample.tick for sample in heard if sample.tick >= back)
    state = daemon.states.now.value
    daemon.stop()
    daemon.wait(20.0)
whole = ticks == list(range(len(ticks)))
print(json.dumps({"whole": whole, "lost": sum(lost), "heard": after >= back, "state": state}))
"""


@pytest.mark.exhaustive
def test_a_lost_network_affects_only_subscribers(record_property: Note) -> None:
    words = ["unshare", "--net", "ip", "link", "set", "lo", "up"]
    if not all(map(shutil.which, words[:3:2])) or run_program(words).returncode:
        pytest.skip("no network of its own: it needs iproute2, and root")
    words = ["unshare", "--net", sys.executable, "-c", NETWORK]
    completed = run_program(words, timeout=START_S, check=True)
    assert json.loads(completed.stdout.splitlines()[-1]) == {"whole": True, "lost": 0, "heard": True, "state": "armed"}
    reaction = {"driver": "replay", "fault": "the link is down for 1000 ticks", "ticks": None, "event": "none"}
    record_property(SEEN, reaction | {"state": "armed", "recovery": "subscribers reconnect automatically"})


SETTLE_FRAMES = 110
"""Frames after a pause that may be zero: 100 ms of waiting for a sample and one step of the ramp."""
STALLED = 30
"""Subscribers that do not read: for each the publisher stores 64 bytes of a message, and the message once."""


def limit_memory(pid: int) -> None:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
    most = pages * resource.getpagesize()
    resource.prlimit(pid, resource.RLIMIT_AS, (most, most))


def open_browser(address: str, closing: ExitStack) -> None:
    """Open another browser that reads the page; ignore a refusal by a page that is no longer running."""
    with suppress(OSError, WebSocketException):
        closing.enter_context(connect_to_page(address))


def wait_for_process(process: subprocess.Popen[str], kind: str, previous: int = 0) -> int:
    """Wait for the process of a daemon with this role, other than `previous`, and return its id."""
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


def test_removed_socket_files_are_bound_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Connected peers stay connected, and new ones connect, also to a process that is restarted afterwards."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = find_runtime_folder()
    telemetry, commands = f"ipc://{folder}/t", f"ipc://{folder}/t.commands"

    def ticks() -> bool:
        with subscribe(telemetry, timeout_s=0.5) as samples:
            return samples.receive(0.5) is not None

    def count_lines() -> int:
        return caplog.text.count("was bound again")

    with (
        make_daemon(changes={"telemetry.endpoint": telemetry}) as daemon,
        Control(commands) as connected,
        subscribe(telemetry, timeout_s=WAIT_S) as samples,
    ):
        daemon.start()
        connected.disarm()
        pids = daemon.publisher.pids
        shutil.rmtree(folder)
        until(lambda: count_lines() == 2)
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        with Control(commands, WAIT_S) as control:
            control.arm()
        until(ticks)
        connected.disarm()
        assert samples.receive(WAIT_S) is not None and daemon.publisher.pids == pids

        socket_file = Path(f"{folder}/t.commands")
        socket_file.unlink()
        socket_file.touch()  # not removed: it may be a file of the user
        until(lambda: "exists and is not a socket" in caplog.text)
        socket_file.unlink()
        until(lambda: count_lines() == 3)
        os.kill(pids["commands"], signal.SIGKILL)
        until(lambda: daemon.publisher.restarts == 1)
        with Control(commands, WAIT_S) as control:
            control.arm()
        replaced = folder.rename(tmp_path / "replaced")
        with listen(commands, "key").files:  # another server claims the path before the daemon
            until(lambda: "is in use: stop" in caplog.text)
            assert socket_file.exists()
        until(lambda: count_lines() == 5)
    assert not socket_file.exists() and replaced.exists()
    assert caplog.text.count("exists and is not a socket") == 1
