"""Exchange of the servo with a Haply's block, call by call: poses, wrenches, withheld forces and counters."""

import ctypes
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.plain_by_call import BY_CALL, HALF, MS, SHIFT, START_NS, FarEnd, File, GuardedBlock, by_call, check_pose

from softfinger.config.errors import DeviceLost, DeviceTimeout
from softfinger.drivers.base import HELD, LOST, OK, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.haply import device as haply_device
from softfinger.drivers.haply import exchange
from softfinger.drivers.haply.exchange import AT, ServiceFrame
from softfinger.proxy.kernels.jit.pack import flatten

pytestmark = BY_CALL

FD = 5
QUIET, TIMEOUT_NS = 20 * MS, 100 * MS
ZERO = (0.0,) * 6
Q = (0.5, 0.1, -0.7, 0.5)


class Device(FarEnd):
    exchange = exchange

    def __init__(self, patch: pytest.MonkeyPatch, mounting: tuple[Any, Any]) -> None:
        self.clock, self.woken = by_call(patch, exchange), File(FD)
        patch.setattr(exchange, "write_now", self.woken.write)
        self.block = GuardedBlock(AT)
        self.clock.room = {self.block.handle + 8 * AT.timespec}
        self.block.numbers(AT.model, exchange.MODEL_SIZE)[:] = flatten(ServiceFrame(*mounting, 5.0))
        self.word[AT.opened_at] = START_NS - 2000 * MS
        self.word[AT.quiet], self.word[AT.timeout_after] = QUIET, TIMEOUT_NS
        self.word[AT.wake], self.word[AT.increment], self.word[AT.armed] = FD, 1, 1

    def state(self, x: float, y: float, z: float, buttons: float = 0.0) -> None:
        pose = self.block.slot(AT.pose, exchange.POSE_SIZE)
        pose.values[:] = (x, y, z, *Q, buttons, float(self.clock.now))
        pose.sequence[0] += 2

    def write(self, *wrench: float, sends: bool = True) -> int:
        status = super().write(*wrench)
        if sends:
            self.word[AT.handled] = self.word[AT.written]
        return status

    def last_wrench(self) -> list[float]:
        """Return the last wrench in the sequence lock: force (N), time (ns), number."""
        wrench = self.block.slot(AT.wrench, exchange.WRENCH_SIZE)
        assert wrench.sequence[0] == 2 * self.word[AT.written]
        return wrench.values.tolist()


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    made = Device(monkeypatch, (SHIFT, (HALF, 0.0, 0.0, HALF)))
    made.state(0.0, 0.0, 0.0)
    assert made.read()[0] == OK
    return made


def test_the_last_state_is_a_pose_in_the_world(device: Device) -> None:
    device.clock.now += 5 * MS
    device.state(0.25, 0.5, -0.125, 3.0)
    device.clock.now += 1 * MS
    for wanted in (OK, STALE):
        status, sample = device.read()
        assert status == wanted
        check_pose(sample, (0.25, 0.5, -0.125), Q, rounding=1e-12)
        assert sample[7:].tolist() == [pytest.approx(2.005), 3.0, 0.0]


def test_a_state_being_written_is_read_in_the_next_tick(device: Device) -> None:
    before = device.read()[1].tolist()
    device.state(1.0, 2.0, 3.0)
    device.word[AT.pose] -= 1
    status, sample = device.read()
    assert (status, sample.tolist()) == (STALE, before)
    device.word[AT.pose] += 1
    assert device.read()[0] == OK


def test_silence_ends_forces_then_the_run(device: Device) -> None:
    for silence, status in ((QUIET, OK), (QUIET + 1, WITHHELD)):
        device.word[AT.read_at] = device.clock.now = START_NS + silence
        assert device.read()[0] == STALE and device.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == status
    assert device.last_wrench()[:3] == [0.0, 0.0, 0.0]
    for silence, status in ((TIMEOUT_NS, STALE), (TIMEOUT_NS + 1, TIMEOUT)):
        device.word[AT.read_at] = device.clock.now = START_NS + silence
        assert device.read()[0] == status


def test_a_pause_of_the_loop_is_no_silence(device: Device) -> None:
    device.clock.now += 2 * TIMEOUT_NS
    assert device.read()[0] == STALE and device.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    # The pause counts as a silence of just more than `quiet_s`; from then on the silence is measured.
    device.clock.now += TIMEOUT_NS - QUIET - 1
    device.word[AT.read_at] = device.clock.now
    assert device.read()[0] == STALE
    device.clock.now += 1
    assert device.read()[0] == TIMEOUT
    device.state(0.0, 0.0, 0.0)
    assert device.read()[0] == OK
    for age, status in ((0, OK), (QUIET, OK), (QUIET + 1, STALE)):
        device.clock.now += 31 * MS
        device.state(0.0, 0.0, 0.0)
        device.clock.now += age
        assert device.read()[0] == status


def test_a_failure_of_the_thread_ends_the_run(device: Device) -> None:
    device.word[AT.failed] = LOST
    assert device.read()[0] == LOST and device.write(0.0, 1.0, 0.0, 0.0, 0.0, 0.0) == LOST
    assert device.write(*ZERO) == OK and device.counts() == {}


def test_a_force_dropped_by_the_thread_is_reported_once(device: Device) -> None:
    device.word[AT.dropped] = 1
    assert [device.read()[0] for _ in range(2)] == [WITHHELD, STALE]
    device.word[AT.dropped] = 3
    for status in (WITHHELD, OK):
        device.state(0.0, 0.0, 0.0)
        assert device.read()[0] == status


def test_a_force_reaches_the_thread_in_the_services_frame(device: Device) -> None:
    before = device.read()[1].tolist()
    device.clock.now += 7
    assert device.write(0.5, -1.0, 2.0, 3.0, 3.0, 3.0) == OK
    np.testing.assert_allclose(device.last_wrench(), [-1.0, -0.5, 2.0, START_NS + 7, 1.0], atol=1e-12)
    assert device.write(0.0, 30.0, -40.0, 0.0, 0.0, 0.0) == STALE
    np.testing.assert_allclose(device.last_wrench(), [3.0, 0.0, -4.0, START_NS + 7, 2.0], atol=1e-12)
    assert device.write(0.0, 0.0, 0.0, 1.0, 1.0, 1.0) == OK  # torque is not displayed
    assert device.last_wrench() == [0.0, 0.0, 0.0, START_NS + 7, 3.0] and device.read()[1].tolist() == before
    assert device.woken.sent == [bytes(ctypes.c_int64(1))] * 3 and device.counts() == {"written": 3, "cut": 1}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_force_that_is_no_number_is_zero(axis: int, bad: float, device: Device) -> None:
    wrench = [0.0] * 6
    wrench[axis], wrench[3] = bad, bad
    assert device.write(*wrench) == WITHHELD and device.last_wrench()[:3] == [0.0, 0.0, 0.0]
    wrench[axis] = 1.0
    assert device.write(*wrench) == OK


def test_withheld_forces(device: Device) -> None:
    for armed, wake in ((0, FD), (1, -1)):
        device.word[AT.armed], device.word[AT.wake] = armed, wake
        assert device.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
        assert device.last_wrench()[:3] == [0.0, 0.0, 0.0] and device.write(*ZERO) == OK
    assert len(device.woken.sent) == 2
    device.word[AT.wake], device.word[AT.lock] = FD, 1
    assert device.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    assert device.write(*ZERO) == WITHHELD and device.counts() == {"written": 4}
    device.word[AT.lock] = 0
    assert device.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == OK and device.word[AT.lock] == 0


def test_a_force_that_waits_to_be_sent_is_not_replaced(device: Device) -> None:
    assert device.write(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, sends=False) == OK
    first = device.last_wrench()
    assert [device.write(0.0, 2.0, 0.0, 0.0, 0.0, 0.0, sends=False) for _ in range(2)] == [HELD, HELD]
    assert device.last_wrench() == first and len(device.woken.sent) == 1
    assert device.counts() == {"written": 1, "held": 2} and device.write(*ZERO, sends=False) == OK
    assert device.last_wrench()[:3] == [0.0, 0.0, 0.0]
    assert device.write(0.0, 3.0, 0.0, 0.0, 0.0, 0.0, sends=False) == HELD
    device.word[AT.armed] = 0
    assert device.write(0.0, 3.0, 0.0, 0.0, 0.0, 0.0, sends=False) == WITHHELD
    device.word[AT.armed], device.word[AT.handled] = 1, device.word[AT.written]
    assert device.write(0.0, 4.0, 0.0, 0.0, 0.0, 0.0) == OK
    assert device.last_wrench()[0] == pytest.approx(4.0) and device.word[AT.lock] == 0


def test_arming_waits_for_a_current_state(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = haply_device.HaplyDevice.__new__(haply_device.HaplyDevice)
    opened._block, opened._options, opened.info = (
        device.block,
        SimpleNamespace(timeout_s=0.1),
        SimpleNamespace(name="x"),
    )
    opened._thread = SimpleNamespace(failure="gone")
    waits = 5

    def sleep(_: float) -> None:
        nonlocal waits
        device.clock.now += MS
        waits -= 1
        if waits == 0:
            device.word[AT.states] += 1

    time = SimpleNamespace(monotonic=lambda: device.clock.now * 1e-9, sleep=sleep)
    monkeypatch.setattr(haply_device, "time", time)
    device.word[AT.armed], device.word[AT.dropped] = 0, 3
    opened.arm()
    assert waits == 0 and device.word[AT.armed] == 1 and device.word[AT.dropped_reported] == 3
    device.word[AT.armed], started = 0, device.clock.now
    with pytest.raises(DeviceTimeout, match="no longer sends states"):
        opened.arm()
    assert device.word[AT.armed] == 0 and 100 * MS <= device.clock.now - started <= 102 * MS
    device.word[AT.failed] = LOST
    with pytest.raises(DeviceLost, match="gone"):
        opened.arm()
    assert device.word[AT.armed] == 0
    device.word[AT.failed], device.word[AT.stopped] = 0, 1
    opened.arm()
    assert device.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
