"""Failing services, the supervisor when ticks stop, the watcher after the end of the daemon, a clock that is set."""

import ctypes
import errno
import fcntl
import os
import queue
import signal
import struct
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
from helpers.waits import ends_within

from softfinger.config.errors import HapticError, RecordingError, SafetyStop
from softfinger.proxy.record import AT, CAUSE_TOUCH, RECORD_SIZE, ROLLING
from softfinger.server import watcher
from softfinger.server.loop.health import STALL_MAX_S, STALL_POLL_S, STALL_POLLS, STALL_POLLS_WITHOUT_HAND
from softfinger.server.metrics.counts import MetricsCollector
from softfinger.server.metrics.service import MetricsService
from softfinger.server.recording.recorder import RecorderState
from softfinger.server.services import recordings
from softfinger.server.services import supervisor as supervising
from softfinger.server.services.commands import CommandService
from softfinger.server.services.scene_topics import WorldState
from softfinger.server.services.supervisor import Supervisor
from softfinger.server.services.watches import DEVICE_WARNING, SWAPPED, DeviceWarnings, HotplugWatch, SwapWatch
from softfinger.server.socket_process import clients
from softfinger.server.socket_process.setup import Figures
from softfinger.server.states import DaemonState
from softfinger.server.wire.events import RecordEvents
from softfinger.server.wire.health import HealthSummary

pytestmark = pytest.mark.plain

WAIT_S = 20.0


class Servo:
    """Servo with a number of ticks computed by a function; its devices display a force that persists, or do not."""

    is_ticking = True

    def __init__(self, read_ticks: Callable[[], int], *persists: bool, is_armed: bool = True) -> None:
        self.read_ticks, self.is_armed, self.looks = read_ticks, is_armed, 0
        infos = [SimpleNamespace(has_persistent_force=force) for force in persists]
        self.devices = tuple(SimpleNamespace(info=info, stop=lambda: None) for info in infos)

    @property
    def ticks(self) -> int:
        self.looks += 1
        return self.read_ticks()


def make_supervisor(servo: Any, fail: Callable[[HapticError], Any], event: Any = lambda *_, **__: None) -> Supervisor:
    return Supervisor(servo, fail, event)


def test_a_supervisor_that_fails_ends_the_run() -> None:
    errors = queue.Queue[HapticError]()

    def break_down() -> int:
        raise OSError("gone")

    supervisor = make_supervisor(Servo(break_down), errors.put)
    supervisor.start()
    error = errors.get(timeout=WAIT_S)
    supervisor.stop()
    assert errors.empty() and isinstance(error, SafetyStop)
    assert "gone" in str(error) and "a stall of the servo would not be detected" in str(error)


def test_a_stall_is_reported_and_every_device_stopped_if_anything_fails() -> None:
    calls: list[str] = []
    ended = threading.Event()

    def stop(name: str) -> None:
        calls.append(f"stop {name}")
        raise OSError("the port has gone")

    def event(kind: str, name: str, **fields: Any) -> None:
        calls.append(f"{kind} {name}")
        ended.set()

    servo = Servo(lambda: 7, True, True)
    for device, name in zip(servo.devices, "ab", strict=True):
        device.stop = partial(stop, name)
    supervisor = make_supervisor(servo, lambda error: calls.append(str(error).partition(" for ")[0]), event)
    supervisor.start()
    assert ended.wait(WAIT_S)
    supervisor.stop()
    assert calls[0] == "no tick" and sorted(calls[1:3]) == ["stop a", "stop b"] and calls[3:] == ["fault stalled"]


@pytest.mark.parametrize(
    ("hold_a_force", "looks"),
    [
        ((True,), STALL_POLLS),
        ((True, False), STALL_POLLS),
        ((False, True), STALL_POLLS),
        ((True, True), STALL_POLLS),
        ((False, False), STALL_POLLS_WITHOUT_HAND),
        ((False,), STALL_POLLS_WITHOUT_HAND),
    ],
)
def test_a_stall_is_longer_without_a_hand(hold_a_force, looks, monkeypatch):
    rests: list[float] = []
    monkeypatch.setattr(supervising.time, "sleep", rests.append)
    servo, errors = Servo(lambda: 7, *hold_a_force), list[HapticError]()
    make_supervisor(servo, errors.append).work()
    assert servo.looks == 1 + looks and rests == [STALL_POLL_S] * (1 + looks)
    assert f"no tick for {looks * STALL_POLL_S:.2f} s after tick 7:" in str(errors[0])


@pytest.mark.parametrize("turn", [0.0, sys.getswitchinterval()])
@pytest.mark.parametrize("share", [1e-9, 0.3, 0.7, 1.0])
def test_a_stall_ends_with_zero_within_the_bound_of_the_fault_model(turn, share, monkeypatch):
    """From the last tick to the stop: STALL_POLLS intervals and the supervisor's turns, at most STALL_MAX_S."""
    rests, stopped = list[float](), list[float]()
    monkeypatch.setattr(supervising.time, "sleep", lambda seconds: rests.append(seconds + turn))
    step = STALL_POLL_S + turn
    last = (3.0 + share) * step  # a tick every millisecond before it, and none afterwards
    servo = Servo(lambda: int(min(sum(rests), last) * 1000.0) + (sum(rests) >= last), True)
    servo.devices[0].stop = lambda: stopped.append(sum(rests) + turn)
    make_supervisor(servo, lambda error: None).work()
    (reaction,) = (when - last for when in stopped)
    assert reaction == pytest.approx((1.0 - share + STALL_POLLS) * step + turn, abs=1e-9)  # rounding of sums
    assert STALL_POLLS * STALL_POLL_S - 1e-9 <= reaction <= STALL_MAX_S


def test_a_servo_that_waits_for_its_devices_is_not_stalled() -> None:
    calls: list[Any] = []
    servo = Servo(lambda: 0, True, is_armed=False)

    def read_ticks() -> int:
        servo.is_ticking = servo.looks < 8 * STALL_POLLS
        return 0

    servo.read_ticks = read_ticks
    make_supervisor(servo, calls.append, lambda *words, **_: calls.append(words)).work()
    assert calls == [] and servo.looks == 8 * STALL_POLLS


ZERO = b"zero\n"
_PR_CAPBSET_DROP, _CAP_SYS_ADMIN = 24, 21


def as_an_ordinary_user() -> None:
    ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_ADMIN, 0, 0, 0)


@pytest.fixture
def port() -> Iterator[tuple[int, int]]:
    far, near = os.openpty()
    tty.setraw(near)
    fcntl.ioctl(near, termios.TIOCEXCL)
    yield far, near
    os.close(near)
    os.close(far)


def watch(name: str, fd: int, stdin: bytes) -> str:
    words = [sys.executable, "-I", "-S", watcher.__file__, name, str(fd), ZERO.hex()]
    process = subprocess.run(
        words, input=stdin, capture_output=True, pass_fds=(fd,), preexec_fn=as_an_ordinary_user, check=True
    )
    return process.stderr.decode()


def test_an_exclusively_open_port_gets_the_zero(port: tuple[int, int]) -> None:
    far, near = port
    name = os.ttyname(near)
    fcntl.ioctl(far, termios.TIOCPKT, struct.pack("i", 1))  # each read has a byte of status
    assert watch(name, near, b"") == f"softfinger watcher: the daemon has died: zero force was written to {name}\n"
    assert os.read(far, 100)[0] & termios.TIOCPKT_FLUSHWRITE
    received = b""
    while len(received) < watcher.ZERO_WRITES * len(ZERO):  # one read may return fewer writes
        status, *data = os.read(far, 100)
        assert status == termios.TIOCPKT_DATA
        received += bytes(data)
    assert received == watcher.ZERO_WRITES * ZERO
    opened = [sys.executable, "-c", f"import os; os.open({name!r}, os.O_RDWR | os.O_NOCTTY)"]
    assert subprocess.run(opened, preexec_fn=as_an_ordinary_user, check=False).returncode == 0


def test_a_device_that_was_closed_is_not_written_to(port: tuple[int, int]) -> None:
    far, near = port
    os.set_blocking(far, False)
    assert watch(os.ttyname(near), near, watcher.CLOSED_MESSAGE) == ""
    with pytest.raises(BlockingIOError):
        os.read(far, 100)


def test_a_failed_zero_is_reported() -> None:
    far, near = os.openpty()
    name = os.ttyname(near)
    os.close(far)
    stderr = watch(name, near, b"")
    os.close(near)
    why = f"zero force could not be written to {name}: {os.strerror(errno.EIO)}"
    assert stderr == f"softfinger watcher: the daemon has died: {why}\n"


def test_a_stopped_watcher_does_not_delay_the_end(port: tuple[int, int]) -> None:
    _, near = port
    watching = watcher.Watcher(os.ttyname(near), near, ZERO)
    pid = watching._process.pid
    os.kill(pid, signal.SIGSTOP)
    with ends_within(60):
        watching.dismiss()
    assert not Path(f"/proc/{pid}").exists()


def test_a_watcher_that_ends_repeatedly_is_reported_once(port: tuple[int, int]) -> None:
    _, near = port
    watching = watcher.Watcher(os.ttyname(near), near, ZERO)
    reports = [watching.supervise()]
    for _ in range(watcher.RESTARTS + 1):
        watching._process.kill()
        watching._process.wait()
        reports.append(watching.supervise())
    reports.append(watching.supervise())
    watching.dismiss()
    acts = [report.rpartition("(-9) and ")[2].partition(":")[0] for report in reports]
    assert acts == ["", *["was restarted"] * watcher.RESTARTS, "is not restarted", ""]


class BrokenSource:
    def __getattr__(self, name: str) -> Any:
        raise OSError(f"{name} is gone")


@pytest.mark.parametrize("name", ["hotplug", "metrics", "world"])
def test_a_failed_service_is_reported_and_ends_nothing(name: str) -> None:
    events, came = [], threading.Event()

    def event(kind: str, fault_name: str, message: str) -> None:
        events.append((kind, fault_name, message))
        came.set()

    broken = BrokenSource()
    if name == "metrics":
        counts = MetricsCollector([""], lambda: (Figures(), 0), RecorderState, lambda: DaemonState.READY)
        files = SimpleNamespace(close=lambda: None)
        bound = SimpleNamespace(endpoint="tcp://127.0.0.1:1", listener=broken, files=files)
        service = MetricsService(bound, counts, event)
    else:
        service = HotplugWatch(broken, event) if name == "hotplug" else WorldState(broken, print, event)
    service.start()
    assert came.wait(WAIT_S)
    service.stop()
    ((kind, fault_name, message),) = events
    assert (kind, fault_name) == ("fault", name) and "is gone" in message


def test_commands_that_fail_end_a_run_that_needs_heartbeats() -> None:
    events, ended, served = [], [], []

    class Failing:
        is_reachable = True

        def end_at(self, time_ns: int) -> None: ...

        def is_inhibited_by(self, why: str) -> bool:
            raise OSError("no memory")

    rig = SimpleNamespace(commands=SimpleNamespace(heartbeat_s=-1.0))  # missed immediately
    rendering = SimpleNamespace(rig=rig, force=Failing())
    actions = SimpleNamespace(
        replace=print,
        publisher=SimpleNamespace(set_preparing=print, serve=served.append),
        fail=ended.append,
        event=lambda *words, **more: events.append((words, more)),
    )
    commands = CommandService("ipc:///nowhere", rendering, actions, "a scene")
    commands.start()
    served[0].each_period()
    commands.stop()
    assert events == [(("fault", "commands"), {"message": "no memory"})]
    assert served[1] is None
    assert all(isinstance(error, SafetyStop) and "no memory" in str(error) for error in ended) and len(ended) == 1


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_a_clock_that_is_set_back_loses_no_event_and_no_second(jump_s: float) -> None:
    records = np.zeros((5000, RECORD_SIZE))
    records[:, AT.tick] = np.arange(5000)
    records[:, AT.timestamp] = 1.7e9 + np.arange(5000) * 1e-3
    records[2500:, AT.timestamp] += jump_s
    touches = [100, 2400, 2501, 4000]
    records[touches, AT.contact_cause] = CAUSE_TOUCH
    records[touches, AT.contact_mode] = ROLLING
    events, health = RecordEvents(), HealthSummary()
    touch_events = [event for event in events.observe(records) if event["name"] == "touch"]
    assert [event["tick"] for event in touch_events] == touches
    seconds = health.add(records, 0)
    counted = sum(sum(second["modes"].values()) for second in seconds)
    assert counted == seconds[-1]["tick"] and counted >= 4000  # the last second may not be over


def test_a_recording_that_is_still_being_opened_is_one_error_at_the_end(monkeypatch, tmp_path):
    """As on a network file system without a server."""
    opening, answered = threading.Event(), threading.Event()

    def hang(*_: object) -> None:
        opening.set()
        answered.wait()
        raise OSError("gone")

    monkeypatch.setattr(recordings, "open_recording", hang)
    monkeypatch.setattr(recordings, "CLOSE_S", 0.05)
    service = recordings.Recordings(None, [""], print)
    path = tmp_path / "a.mcap"

    def record() -> None:
        with pytest.raises(RecordingError, match="gone"):
            service.record(path, "a scene")

    client = threading.Thread(target=record)
    client.start()
    assert opening.wait(WAIT_S)
    with ends_within(60), pytest.raises(RecordingError, match=rf"^{path}: cannot be opened, because its disk"):
        service.stop()
    answered.set()
    client.join()
    service.stop()


def test_memory_in_swap_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    events, status = [], tmp_path / "status"
    watch = SwapWatch(lambda kind, name, message: events.append((kind, name, message)), status)
    for kilobytes in (0, 40, 80, 0, 12):
        status.write_text(f"Name:\tpython3\nVmStk:\t   132 kB\nVmSwap:\t   {kilobytes} kB\nThreads:\t3\n")
        watch.check()
    assert [(kind, name, message.split(":")[0]) for kind, name, message in events] == [
        ("fault", SWAPPED, f"{kilobytes} kB of the daemon are in swap") for kilobytes in (40, 12)
    ]
    assert caplog.text.count("softfinger doctor") == 2


def test_the_first_check_is_immediate_and_failures_are_events(tmp_path: Path) -> None:
    events: list[Any] = []
    watch = SwapWatch(lambda *words, **fields: events.append((words, fields)), tmp_path / "nothing")
    watch.start()
    watch._thread.join(10.0)
    watch.stop()
    ((words, fields),) = events
    assert words == ("fault", SWAPPED) and "No such file" in fields["message"]


def test_each_warning_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    warning, events = [""], []
    device: Any = SimpleNamespace(info=SimpleNamespace(name="arm"), warning=lambda: warning[0])
    watch = DeviceWarnings(lambda: [device], lambda kind, name, message: events.append((kind, name, message)))
    for words in ("", "hot", "hot", "hotter", "", "", "hot"):
        warning[0] = words
        watch.check()
    assert events == [("fault", DEVICE_WARNING, f"arm: {words}") for words in ("hot", "hotter", "hot")]
    assert caplog.text.count("arm: hot") == 3


def test_a_failing_check_is_published() -> None:
    messages = []
    DeviceWarnings(list, lambda *_, message: messages.append(message)).handle_failure(ValueError("broken"))
    assert messages == ["warnings of devices are no longer reported: broken"]


DISARM = msgpack.packb({"command_id": "a", "method": "disarm"})


def test_clients_take_turns() -> None:
    queue = clients.RequestQueue()
    for client, body in ((b"a", b"1"), (b"a", b""), (b"a", b"3"), (b"b", b"4")):
        assert queue.add(client, body, False)
    assert [queue.pop() for _ in range(len(queue))] == [(b"a", b"1"), (b"b", b"4"), (b"a", b""), (b"a", b"3")]
    assert not queue


@pytest.mark.parametrize(("count", "body"), [(clients.QUEUED_MAX, b""), (1, bytes(clients.QUEUED_BYTES_MAX))])
def test_a_full_queue_refuses_only_clients_that_have_requests_in_it(count: int, body: bytes) -> None:
    queue = clients.RequestQueue()
    assert all(queue.add(b"a", body, False) for _ in range(count))
    assert not queue.add(b"a", b"", False) and not queue.add(b"b", b"", True)
    others = [bytes([1, number // 256, number % 256]) for number in range(1, clients.CLIENTS_MAX)]
    assert all(queue.add(other, b"", False) for other in others) and not queue.add(b"b", b"", False)
    for _ in range(2):  # of the first client, which may have further ones, and of the second
        queue.pop()
    assert len(queue) == count + len(others) - 2 and queue.add(b"b", b"", False)


def test_a_request_that_turns_the_force_off_is_accepted_despite_a_flood() -> None:
    queue = clients.RequestQueue()
    assert all(queue.add(b"a", b"", False) for _ in range(clients.QUEUED_MAX))
    assert all(queue.add(b"a", DISARM, True) for _ in range(clients.QUEUED_MAX)) and not queue.add(b"a", DISARM, False)
    assert queue.add(b"b", DISARM, True)


def test_a_refusal_has_the_id_of_its_request() -> None:
    def answered(body: bytes) -> str:
        answer = msgpack.unpackb(clients.encode_busy(body))
        assert answer == {
            "command_id": answer["command_id"],
            "success": False,
            "result": {},
            "error": clients.BUSY_MESSAGE,
        }
        return str(answer["command_id"])

    assert answered(DISARM) == "a"
    for body in (b"", b"\xc1", b"\x91" * 3000, msgpack.packb({"command_id": 1}), msgpack.packb({"a": 1})):
        assert answered(body) == ""
    assert answered(msgpack.packb({"command_id": 129 * "x"})) == ""
