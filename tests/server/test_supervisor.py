"""Supervisor when ticks stop, and watcher after the end of the daemon."""

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

import pytest
from helpers.waits import ends_within

from softfinger.config.errors import HapticError, SafetyStop
from softfinger.drivers.base import ZeroCommand
from softfinger.server import watcher
from softfinger.server.loop.fault_detection import STALL_MAX_S, STALL_POLL_S, STALL_POLLS, STALL_POLLS_WITHOUT_HAND
from softfinger.server.services import supervisor as supervising
from softfinger.server.services.supervisor import Supervisor
from softfinger.server.verbs import run

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


def test_a_supervisor_ends_before_a_servo_that_never_starts() -> None:
    supervisor = make_supervisor(Servo(lambda: 0, is_armed=False), pytest.fail)
    supervisor.start()
    supervisor.stop()
    assert not supervisor._thread.is_alive()


def test_an_armed_servo_is_monitored_until_its_last_tick() -> None:
    errors = queue.Queue[HapticError]()
    supervisor = make_supervisor(Servo(lambda: 0), errors.put)
    supervisor.closing.set()
    supervisor.start()
    assert isinstance(errors.get(timeout=WAIT_S), SafetyStop)


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
    words = [sys.executable, "-I", "-S", watcher.__file__, name, str(fd), ZERO.hex(), "0", "0"]
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
    watching = watcher.Watcher(*ZeroCommand(os.ttyname(near), near, ZERO))
    pid = watching._process.pid
    os.kill(pid, signal.SIGSTOP)
    with ends_within(60):
        watching.dismiss()
    assert not Path(f"/proc/{pid}").exists()


def test_a_watcher_that_ends_repeatedly_is_reported_once(port: tuple[int, int]) -> None:
    _, near = port
    watching = watcher.Watcher(*ZeroCommand(os.ttyname(near), near, ZERO))
    reports = [watching.supervise()]
    for _ in range(watcher.RESTARTS + 1):
        watching._process.kill()
        watching._process.wait()
        reports.append(watching.supervise())
    reports.append(watching.supervise())
    watching.dismiss()
    acts = [report.rpartition("(-9) and ")[2].partition(":")[0] for report in reports]
    assert acts == ["", *["was restarted"] * watcher.RESTARTS, "is not restarted", ""]


def test_a_watcher_is_known_if_the_next_one_cannot_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise nothing would end it."""

    def start(node: str, *_: object) -> str:
        if node == "second":
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        return node

    monkeypatch.setattr(run, "Watcher", start)
    words = [ZeroCommand(node, 3, ZERO) for node in ("first", "second")]
    devices = [SimpleNamespace(zero_command=lambda word=word: word, info=SimpleNamespace(name="x")) for word in words]
    watchers: list[Any] = []
    with pytest.raises(OSError, match="temporarily"):
        run.start_watchers(SimpleNamespace(devices=devices), watchers, False)  # type: ignore[arg-type]
    assert watchers == ["first"]
