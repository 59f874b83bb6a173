"""Shutdown: every step runs regardless of earlier failures, every device gets zero, and errors contain a remedy."""

import ctypes
import logging
import os
import threading
import tty
from contextlib import suppress
from math import nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.waits import WAIT_S

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, SafetyStop
from softfinger.drivers import open_devices
from softfinger.drivers.base import FORCE_OFF, LOST, PROTOCOL, TIMEOUT, DeviceIO
from softfinger.server.loop import fault_detection, shutdown
from softfinger.server.loop.shutdown import READ_FAILED, STOPPED, WRITE_FAILED, LoopEnd
from softfinger.server.watcher import write_zero_force

pytestmark = pytest.mark.plain

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))


class Motor:
    """Device that records its wrenches; `stop` and `close` can fail or hang."""

    def __init__(self, fails: BaseException | None = None, hangs: bool = False, reply: str = "") -> None:
        self.info = SimpleNamespace(name="Motor")
        self.fails, self.hangs, self.reply = fails, hangs, reply
        self.wrenches: list[list[float]] = []
        self.handles: list[int] = []
        self.closed = 0
        self.free = threading.Event()
        self._write = FUNCTION(self._taken)

    def _taken(self, handle: int, wrench: Any) -> int:
        self.handles.append(handle)
        self.wrenches.append(wrench[:6])
        return 0

    def io(self) -> DeviceIO:
        address = ctypes.cast(self._write, ctypes.c_void_p).value
        return DeviceIO(address, address, 77)

    def reason(self) -> str:
        return self.reply

    def stop(self) -> None:
        if self.hangs:
            self.free.wait()
        if self.fails is not None:
            raise self.fails
        self._taken(0, [0.0] * 6)

    def close(self) -> None:
        self.closed += 1
        self.stop()


@pytest.fixture
def short_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_devices, "STOP_TIMEOUT_S", 0.2)


def make_failing(error: BaseException) -> Any:
    def act(*_: object) -> None:
        raise error

    return act


def test_every_step_runs_and_the_first_error_is_returned(caplog: pytest.LogCaptureFixture) -> None:
    steps_run: list[int] = []
    first = ValueError("one")
    done, interrupted = (lambda: steps_run.append(1), lambda: steps_run.append(2)), make_failing(KeyboardInterrupt())
    with caplog.at_level(logging.ERROR):
        assert shutdown.run_all_steps(make_failing(first), done[0], interrupted, done[1]) is first
    assert steps_run == [1, 2]
    assert [record.getMessage() for record in caplog.records] == ["during shutdown, besides: KeyboardInterrupt"]
    assert shutdown.run_all_steps(lambda: None) is None
    with pytest.raises(ValueError, match="one"):
        shutdown.complete_all_steps(make_failing(first), lambda: steps_run.append(3))
    assert steps_run == [1, 2, 3]


def test_an_earlier_error_remains_the_first(caplog: pytest.LogCaptureFixture) -> None:
    before = SafetyStop("stalled")
    with caplog.at_level(logging.ERROR):
        assert shutdown.run_all_steps(make_failing(OSError("gone")), first=before) is before
    assert "besides: gone" in caplog.text


@pytest.mark.parametrize("error", [OSError("the port has gone"), DeviceLost("it is gone"), KeyboardInterrupt()])
def test_a_failing_stop_is_followed_by_a_plain_zero(error: BaseException) -> None:
    motor = Motor(error)
    with pytest.raises(BaseException) as caught:  # noqa: PT011
        shutdown.stop(motor)
    assert motor.handles == [77] and motor.wrenches == [[0.0] * 6]
    if isinstance(error, OSError):
        assert type(caught.value) is DeviceError and caught.value.__cause__ is error
        assert "Motor could not be stopped (OSError: the port has gone)" in str(caught.value)
        assert "switch it off" in str(caught.value)
    else:
        assert caught.value is error


def test_an_unconfirmed_zero_is_an_error() -> None:
    class Quiet(Motor):
        why = ""

        def zero_failure(self) -> str:
            return self.why

    sound, dead = Quiet(), Quiet()
    shutdown.confirm_zero([sound, dead])
    dead.why = "8 bytes have been pending"
    with pytest.raises(DeviceError, match=r"^Motor: .* not confirmed \(8 bytes have been pending\): .*switch it off"):
        shutdown.confirm_zero([sound, dead])


def test_a_watcher_discards_queued_bytes_before_its_zero() -> None:
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(near, False)
    with suppress(BlockingIOError):
        while os.write(near, b"force"):
            pass
    assert write_zero_force("the node", near, b"zero!") == "zero force was written to the node"
    received = os.read(far, 1 << 16)
    while not received.endswith(b"zero!" * 3):
        received += os.read(far, 1 << 16)
    assert len(received) <= 4096 + 3 * 5  # bytes already at the far end, of some 16 kB
    os.close(near)
    os.close(far)


@pytest.mark.usefixtures("short_timeout")
@pytest.mark.parametrize(("act", "acted"), [(shutdown.stop_all, "stopped"), (shutdown.close_all, "closed")])
def test_all_devices_are_stopped_or_closed_if_some_fail_or_hang(act, acted, caplog):
    hangs, broken, sound = Motor(hangs=True), Motor(OSError("no power")), Motor()
    message = rf"be {acted} \(the call has not returned for 0\.2 s.*switch"
    with caplog.at_level(logging.ERROR), pytest.raises(DeviceError, match=message):
        act([hangs, broken, sound])
    assert f"could not be {acted} (OSError: no power)" in caplog.text and caplog.text.count("besides") == 1
    assert hangs.handles == broken.handles == ([77] if acted == "stopped" else [])
    assert sound.handles == [0] and sound.closed == (acted == "closed")
    hangs.free.set()
    act([])


@pytest.mark.usefixtures("short_timeout")
def test_hanging_devices_share_one_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    waits, wait = list[float](), threading.Event.wait

    def noted(event: threading.Event, timeout: float | None = None) -> bool:
        waits.extend([] if timeout is None else [timeout])
        return wait(event, timeout)

    monkeypatch.setattr(threading.Event, "wait", noted)
    motors = [Motor(hangs=True) for _ in range(10)]
    failures = open_devices.call_all(Motor.stop, [*motors, Motor()])
    assert sum(waits) <= open_devices.STOP_TIMEOUT_S and len(waits) == 11
    assert [motor for motor, _ in failures] == motors
    assert all(isinstance(error, TimeoutError) for _, error in failures)
    for motor in motors:
        motor.free.set()


def test_devices_are_called_simultaneously(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call waits for the other, so sequential calls would not return."""
    monkeypatch.setattr(open_devices, "STOP_TIMEOUT_S", WAIT_S)
    both = threading.Barrier(2, timeout=WAIT_S / 4)
    assert open_devices.call_all(lambda _: both.wait() and None, [Motor(), Motor()]) == []


def test_a_signal_stops_and_closes_all_open_devices() -> None:
    error = OSError("no power")
    motors = [Motor(error), Motor()]
    open_devices.devices.update(motors)
    assert open_devices.stop_all() == [error]
    open_devices.close_all()
    assert [motor.closed for motor in motors] == [1, 1]


def test_a_zero_overwrites_all_components() -> None:
    motor = Motor()
    io, scratch = motor.io(), np.full(6, nan)
    write_zero: Any = getattr(shutdown.write_zero, "py_func", shutdown.write_zero)
    calls: list[Any] = []
    globals_of = write_zero.__globals__
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(globals_of, "call_device", lambda address, handle, v: calls.append([address, handle, v.tolist()]))
        write_zero(io.write, io.handle, scratch)
    assert calls == [[io.write, 77, [0.0] * 6]]


SAID = "its driver said why"


@pytest.mark.parametrize(
    ("ending", "status", "kind", "words"),
    [
        (fault_detection.NO_POSE, 0, DeviceError, ["no usable pose for", "check its sensors"]),
        (fault_detection.JUMPING, 0, DeviceError, ["jumps repeatedly", "guard.speed_max_m_per_s"]),
        (READ_FAILED, FORCE_OFF, SafetyStop, ["disabled its force"]),
        (READ_FAILED, TIMEOUT, DeviceTimeout, ["no answer to a read in time"]),
        (WRITE_FAILED, TIMEOUT, DeviceTimeout, ["no answer to a write in time"]),
        (READ_FAILED, PROTOCOL, DeviceLost, ["violates its protocol", "on read"]),
        (WRITE_FAILED, LOST, DeviceLost, ["is gone", "on write"]),
    ],
)
def test_a_device_failure_is_reported_with_a_remedy(ending, status, kind, words):
    ended = LoopEnd(ending, status)
    error = shutdown.describe_failure(Motor(reply=SAID), ended, "thumb")
    assert type(error) is kind
    assert all(word in str(error) for word in [*words, "Motor, finger 'thumb'", f"({SAID})", "start again"])
    plain = str(shutdown.describe_failure(Motor(), ended))
    assert "finger" not in plain.replace("fingertip", "") and "()" not in plain


@pytest.mark.parametrize("ending", [STOPPED, fault_detection.NO_FORCE, fault_detection.STARVED])
def test_other_failures_are_not_errors_of_the_device(ending: int) -> None:
    assert shutdown.describe_failure(Motor(), LoopEnd(ending, 0)) is None


def test_a_loop_failure_is_reported_with_a_remedy() -> None:
    assert shutdown.describe_loop_failure(LoopEnd(READ_FAILED, LOST), 10, 2, False) is None
    scene = shutdown.describe_loop_failure(LoopEnd(fault_detection.NO_FORCE, 0), 10, 2, False)
    assert isinstance(scene, SafetyStop) and "softfinger check" in str(scene)
    device_slow = str(shutdown.describe_loop_failure(LoopEnd(fault_detection.STARVED, 0), 10, 2, False))
    assert "2 of 12 deadlines" in device_slow and "in the device's exchange" in device_slow
    machine = str(shutdown.describe_loop_failure(LoopEnd(fault_detection.STARVED, 0), 10, 2, True))
    assert "before the servo thread was woken" in machine and "softfinger doctor" in machine
