"""Faults of the machine during a run: processes sleep, clocks are set, the network is lost."""

import contextlib
import json
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from faults_seen import SEEN
from helpers.c_stub import COMPILER, NO_COMPILER, compile_stub
from helpers.processes import find_child, list_children, read_state
from helpers.programs import run_program
from helpers.serial_devices import at_rest
from helpers.waits import until
from test_signals import END_S, FORCE_N, START_S, ZERO, pressing

from softfinger.proxy.record import AT
from softfinger.server.loop.guard import RAMPING
from softfinger.server.recording.reader import Event, TickBlock, read_contents
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.control import Control

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
