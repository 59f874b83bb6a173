"""Servo loop: calls, forbidden operations, faults of devices and ends."""

import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.allocations import HAS_COMPILER, counted
from helpers.faulty_device import FaultyDevice, Options

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.base import LOST, PROTOCOL
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop import servo_thread as s
from softfinger.server.loop import shutdown
from softfinger.server.loop.guard import RAMPING, SLEW_LIMITED
from softfinger.server.loop.tuning import make_tuning

pytestmark = pytest.mark.real_time

FORCE = AT.force
FULL_N = 1.2
"""Upper bound of the faulty device's force: 1 N pressed, and 0.6 times that of friction."""


def make_servo(
    options: Options, ticks: int | None, prepare: Callable[[], Any] | None = None, rate: float = 1000.0
) -> tuple[FaultyDevice, s.ServoThread]:
    device = FaultyDevice(options)
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard, [device.info])
    servo = s.ServoThread([device], tuning, rate, ticks, prepare)
    servo.compile()
    return device, servo


def finish(servo: s.ServoThread) -> tuple[s.LoopEnd, np.ndarray]:
    """Start, wait for the end, and return the end and the remaining records."""
    servo.start()
    ended = servo.join(30.0)
    assert ended is not None
    out = np.empty((16384, RECORD_SIZE))
    records = out[: servo.records.take(out)]
    servo.close()
    return ended, records


def test_exception_in_the_servo_thread_zeroes_the_device():
    def prepare():
        raise RuntimeError("refused")

    device, servo = make_servo(Options(), 100, prepare)
    ended, _ = finish(servo)
    assert ended.ending == s.CRASHED and str(ended.error) == "refused"
    assert len(device.wrenches) == 1 and not device.wrenches[-1].any()
    assert [act for act, *_ in device.acts] == ["stop"]  # never armed


def test_an_unconfirmed_zero_at_the_end_is_an_error(monkeypatch):
    monkeypatch.setattr(FaultyDevice, "zero_failure", lambda device: "it is stuck")
    _, servo = make_servo(Options(), 10)
    ended, _ = finish(servo)
    assert ended.ending == s.CRASHED and "zero force is not confirmed (it is stuck)" in str(ended.error)


def test_a_servo_that_is_stopped_before_it_runs_arms_nothing():
    device, servo = make_servo(Options(), 100)
    servo.stop()
    ended, records = finish(servo)
    assert (ended.ending, len(records)) == (s.STOPPED, 0)
    assert [act for act, *_ in device.acts] == ["stop"]


@pytest.mark.parametrize("ticks", [50, None])
def test_a_device_whose_stop_fails_gets_zero(ticks, caplog):
    undone = []
    device, servo = make_servo(Options(stop_fails=True, fault="lost", at=100), ticks, lambda: lambda: undone.append(1))
    ended, _ = finish(servo)
    assert undone == [1] and not device.wrenches[-1].any() and device.wrenches[:-1].any()
    message = str(ended.error) if ticks else caplog.text  # if the device was lost first, that is the error
    assert (ended.ending, ended.status) == ((s.CRASHED, 0) if ticks else (shutdown.READ_FAILED, LOST))
    assert "could not be stopped" in message and "the port has gone" in message and "switch it off" in message


@pytest.mark.parametrize("direction", ["read", "write"])
def test_an_unknown_status_is_a_fault(direction):
    _, servo = make_servo(Options(fault=f"unknown_{direction}", at=700), 2000)
    ended, records = finish(servo)
    assert ended.status == PROTOCOL and len(records) == 700


@pytest.mark.parametrize("stall_us", [5_500, 60_000])
def test_the_force_does_not_jump_after_a_stall(stall_us):
    _, servo = make_servo(Options(fault="stall_and_jump", at=700, stall_us=stall_us), 900)
    _, records = finish(servo)
    force = records[:, FORCE : FORCE + 3]
    assert np.linalg.norm(force[720:], axis=1).min() > 7.0  # it is 8 mm deep now
    assert int(records[702, AT.servo_guard]) & SLEW_LIMITED
    step = load_rig("replay").guard.force_slew_n_per_s / 1000.0
    assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() <= step * (1 + 1e-9)  # rounding of a norm


def test_after_a_long_pause_the_force_fades_in():
    _, servo = make_servo(Options(fault="stall", at=700, stall_us=150_000), 900)
    _, records = finish(servo)
    force = np.linalg.norm(records[:, FORCE : FORCE + 3], axis=1)
    assert force[699] > 0.9 and force[701] < 0.01
    assert int(records[701, AT.servo_guard]) & RAMPING
    assert (force[701:] <= 0.002 * np.arange(1, 200) * FULL_N).all()


@pytest.mark.parametrize("own_clock", [False, True])
def test_missed_deadlines_are_counted_and_not_caught_up(own_clock):
    _, servo = make_servo(Options(fault="stall", at=50, stall_us=5500, own_clock=own_clock), 200)
    _, records = finish(servo)
    ticks, missed, dt = (records[:, at] for at in (AT.tick, AT.servo_missed, AT.dt))
    assert ticks.tolist() == list(range(200))
    assert missed[51] - missed[50] >= 5  # more if the machine itself stalled at that moment
    steps = np.ones(200) if own_clock else 1.0 + np.diff(missed, prepend=0.0)
    assert dt.tolist() == (steps * 0.001).tolist()
    # Deadlines stay on one grid: wake-up time minus lateness is a multiple of the period after the first.
    deadline = records[:, AT.timestamp] - records[:, AT.servo_late]
    phase = (deadline - deadline[0]) / 0.001
    # A float64 of the seconds since the epoch resolves 0.24 us, twice.
    assert np.abs(phase - np.round(phase)).max() < 1e-3
    assert np.array_equal(np.round(np.diff(phase)), 1.0 + np.diff(missed))


def test_no_page_fault_in_the_loop():
    def count_page_faults(ticks: int) -> int:
        counts = list[int]()

        def count_faults() -> Callable[[], Any]:
            counts.append(resource.getrusage(resource.RUSAGE_THREAD).ru_minflt)
            return count_faults

        _, servo = make_servo(Options(), ticks, count_faults, rate=8000.0)
        finish(servo)
        return counts[1] - counts[0]

    count_page_faults(50)
    # The device stores its wrenches in new memory: 48 bytes per tick, a page every 85 ticks.
    kept_by_device = 5000 * 48 // 4096 + 1
    assert count_page_faults(5000) - count_page_faults(50) <= kept_by_device + 2


COUNT = """
import ctypes, sys
sys.path[:0] = sys.argv[1:]
from helpers.faulty_device import Options
from test_servo import make_servo, finish
shim = ctypes.CDLL(None)
shim.allocations.restype = ctypes.c_long
def count(ticks):
    seen = []
    def prepare():
        seen.append(shim.allocations())
        return lambda: seen.append(shim.allocations())
    _, servo = make_servo(Options(), ticks, prepare, rate=8000.0)
    finish(servo)
    return seen[1] - seen[0]
count(10)
print(count(10), count(8000))
"""


@pytest.mark.skipif(not HAS_COMPILER, reason="counting calls of malloc needs a C compiler to build the shim")
def test_loop_never_calls_malloc(tmp_path):
    few, many = map(int, counted(tmp_path, COUNT, str(Path(__file__).parents[1]), str(Path(__file__).parent)).split())
    assert few > 0  # the shim does count: entering the loop from Python allocates
    assert many == few


def test_other_parts_are_refused():
    _, servo = make_servo(Options(), 10)
    tuning = make_tuning(load_scene("frictionless-plane"), load_rig("replay").guard)
    with pytest.raises(ValueError, match="other parts"):
        servo.tune(tuning)
    finish(servo)
