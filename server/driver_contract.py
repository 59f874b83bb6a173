"""Requirements of every driver as one class of pytest tests, for the drivers of this package and of other packages.

A test module subclasses `DriverContract` and defines a fixture `bench`. The bench replaces the hardware: it opens
the device and causes its failures. The tests call the C functions as the servo does. docs/devices/writing-a-driver.md
has an example. Only tests import this module: the package does not require pytest.
"""

from __future__ import annotations

import ctypes
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import ClassVar, Final

import numpy as np
import pytest

from softfinger.config.errors import DeviceBusy, DeviceNotFound, DevicePermission, HapticError
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.base import END, LOST, OK, SAMPLE_SIZE, STALE, TIMEOUT, WITHHELD, Device
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.shutdown import CRASHED, FINISHED, READ_FAILED, STOPPED, WRITE_FAILED
from softfinger.server.loop.tick import Tuning
from softfinger.server.loop.tuning import make_tuning

Function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))

RATE_HZ: Final = 1000.0

REFUSALS: Final[Mapping[str, type[HapticError]]] = {
    "not_found": DeviceNotFound,
    "busy": DeviceBusy,
    "permission": DevicePermission,
}
"""Reasons why a device cannot be opened, and the error for each."""

FAULTS: Final[Mapping[str, int]] = {"lost": LOST, "timeout": TIMEOUT}
"""Failures of an open device, and the status that the next read returns."""


class DeviceCaller:
    """Caller of a device's C functions; arms the device first, unless `arm` is false."""

    def __init__(self, device: Device, arm: bool = True) -> None:
        if arm:
            device.arm()
        self._io = device.io()
        self._read, self._write = Function(self._io.read), Function(self._io.write)

    def read(self) -> tuple[int, list[float]]:
        sample = (ctypes.c_double * SAMPLE_SIZE)(*[math.nan] * SAMPLE_SIZE)
        return self._read(self._io.handle, sample), list(sample)

    def write(self, *wrench: float) -> int:
        status: int = self._write(self._io.handle, (ctypes.c_double * 6)(*wrench))
        return status


class Bench(ABC):
    """Hardware or emulator under a driver. `cannot` has the reason for each of REFUSALS and FAULTS it cannot cause."""

    cannot: ClassVar[Mapping[str, str]] = {}
    refusals: ClassVar[Mapping[str, type[HapticError]]] = REFUSALS
    force_step_n: ClassVar[float] = 1e-12
    """Largest difference between displayed and written force: one step of the device; rounding by default."""
    patience_s: ClassVar[float] = 0.0
    """Time limit for a failure to be reported; 0: the next read. Longer for devices that are read without waiting."""

    @abstractmethod
    def open(self) -> Device:
        """Open a device; the caller arms it before the exchange."""

    @abstractmethod
    def displayed(self) -> tuple[float, ...]:
        """Return the wrench on the hand in the world frame, measured at the device and not reported by the driver."""

    def part(self, *force: float) -> tuple[float, ...]:
        """Return the part of a force (3,) N that the device has motors for: all of it, if it has three or more."""
        return force

    def make(self, case: str) -> None:
        """Cause a case of REFUSALS or FAULTS until `mend`."""
        raise NotImplementedError(case)

    def mend(self) -> None:
        """Undo `make`."""
        raise NotImplementedError


PULL: Final = {
    "fingertip": {"radius_m": 0.01},
    "object": [
        {"name": "floor", "shape": "plane", "motion": {"kind": "driven"}, "material": {"stiffness_n_per_m": 1000.0}}
    ],
    "effect": [{"kind": "constant_force", "force_n": [0.6, 0.0, 0.8]}],
}
"""Scene that pulls with 1 N at every position and pushes upwards below z = 0. Nothing drives its floor: the tests of
this package share the compiled loop with those of commands."""


def make_pulling_tuning() -> Tuning:
    """Return the tuning of the scene `PULL`, with a guard that ramps in within 10 ms."""
    return make_tuning(load_scene(PULL), load_rig("replay", {"guard.ramp_s": 0.01}).guard)


class DriverContract:
    """Tests of a driver: first with a device that answers, then with one that does not."""

    @pytest.fixture
    def device(self, bench: Bench) -> Iterator[Device]:
        with bench.open() as opened:
            yield opened

    def test_every_case_is_answered(self, bench: Bench) -> None:
        """The bench can cause each case, or gives the reason why the case cannot occur."""
        assert set(bench.cannot) <= {*REFUSALS, *FAULTS}
        assert set(bench.refusals) <= set(REFUSALS)
        assert all(len(reason) > 10 for reason in bench.cannot.values())
        assert {*bench.refusals} - {*bench.cannot} == {*REFUSALS} - {*bench.cannot}

    def test_info_is_usable(self, device: Device) -> None:
        """Limits are finite and not negative, and the workspace has min <= max."""
        info = device.info
        assert info.name
        assert 1 <= info.sensed_dof <= 6
        assert 0 <= info.actuated_dof <= 6
        for limit in (info.force_max_n, info.torque_max_nm, info.stiffness_max_n_per_m, info.damping_max_ns_per_m):
            assert math.isfinite(limit)
            assert limit >= 0.0
        assert all(low <= high for low, high in zip(info.workspace_min_m, info.workspace_max_m, strict=True))

    def test_addresses_stay(self, device: Device) -> None:
        """`io` returns the same three addresses on each call."""
        assert device.io() == device.io()
        assert all(device.io())

    def test_read_fills_the_whole_sample(self, device: Device) -> None:
        """A good read writes all values of the sample: finite numbers and a unit quaternion."""
        status, sample = DeviceCaller(device).read()
        assert status in (OK, STALE)
        assert all(math.isfinite(value) for value in sample)
        assert math.hypot(*sample[3:7]) == pytest.approx(1.0, abs=1e-9)  # rounding of a normalisation

    def test_device_time_does_not_run_back(self, device: Device) -> None:
        """Device time never decreases between reads."""
        servo = DeviceCaller(device)
        times = [servo.read()[1][7] for _ in range(20)]
        assert times == sorted(times)

    def test_counts_never_fall(self, device: Device) -> None:
        """Counters are named integers from 0 that never decrease; if there are any, one counts the exchanges."""
        servo = DeviceCaller(device)
        before = device.counts()
        for _ in range(20):
            servo.read()
            servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        after = device.counts()
        assert before.keys() == after.keys()
        assert all(type(value) is int for value in after.values())
        assert all(0 <= before[name] <= after[name] for name in before)
        assert not after or after != before

    def test_write_is_accepted_while_armed(self, device: Device, bench: Bench) -> None:
        """An armed device accepts a small force and displays it in the world frame."""
        servo = DeviceCaller(device)
        servo.read()
        assert servo.write(0.1, 0.2, 0.3, 0.0, 0.0, 0.0) in (OK, STALE)
        assert bench.displayed()[:3] == pytest.approx(bench.part(0.1, 0.2, 0.3), abs=bench.force_step_n)

    def test_arming_is_the_last_act_before_the_first_tick(self, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        """The servo thread arms the device once, immediately before the first exchange, even after a long wait.

        The device fails neither before nor after, and displays the force.
        """
        with bench.open() as device:
            arm, acts = device.arm, []

            def log_and_arm() -> None:
                arm()
                acts.append(("armed", threading.get_native_id()))

            def slow() -> Callable[[], None]:
                time.sleep(1.0)  # as long as real-time settings may take, and longer than any watchdog
                acts.append(("prepared", threading.get_native_id()))
                return lambda: None

            monkeypatch.setattr(device, "arm", log_and_arm)
            servo = ServoThread([device], make_pulling_tuning(), RATE_HZ, 100, slow)
            servo.compile()
            servo.start()
            end = servo.join(30.0)
            assert end is not None
            assert (end.ending, end.error) == (FINISHED, None)
            assert [act for act, _ in acts] == ["prepared", "armed"]
            assert acts[0][1] == acts[1][1]
            assert find_last_force(servo) > 0.0
            servo.close()

    def test_a_device_that_is_not_armed_displays_nothing(self, bench: Bench) -> None:
        """A device that was never armed displays no force after `stop`, which raises nothing."""
        with bench.open() as device:
            device.stop()
            assert not any(bench.displayed())

    def test_stop_may_be_repeated_and_disarms(self, device: Device) -> None:
        """After repeated `stop`, a write does not apply the full force and reads still work."""
        servo = DeviceCaller(device)
        servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
        device.stop()
        device.stop()
        assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) != OK
        assert servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, STALE, WITHHELD)
        assert servo.read()[0] in (OK, STALE, END, WITHHELD)

    def test_close_may_be_repeated(self, device: Device) -> None:
        """`close` after `stop` and after `close` does nothing and raises nothing."""
        device.stop()
        device.close()
        device.close()

    def test_a_closed_device_can_be_opened_again(self, device: Device, bench: Bench) -> None:
        """A closed device can be opened again and armed."""
        device.close()
        with bench.open() as reopened:
            servo = DeviceCaller(reopened)
            assert servo.read()[0] in (OK, STALE)
            assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, STALE)
            assert math.hypot(*bench.displayed()) > 0.0

    @pytest.mark.parametrize("ending", ["stop", "close", "error"])
    def test_no_force_remains_without_a_servo(self, ending: str, bench: Bench) -> None:
        """`stop`, `close` and an exception in the context, which propagates unchanged, all remove an applied force."""
        device = bench.open()
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
        assert math.hypot(*bench.displayed()) > 0.0
        if ending == "stop":
            device.stop()
        elif ending == "close":
            device.close()
        else:
            with pytest.raises(ZeroDivisionError), device:
                raise ZeroDivisionError
        assert not any(bench.displayed())
        device.close()

    @pytest.mark.parametrize("ending", ["last_tick", "stop_word", "crash"])
    def test_no_force_remains_after_a_servo(self, ending: str, bench: Bench) -> None:
        """The force is removed after the last tick, after a stop, and after an exception in the servo thread."""
        with bench.open() as device:
            servo = ServoThread(
                [device],
                make_pulling_tuning(),
                RATE_HZ,
                100 if ending == "last_tick" else None,
                fail_to_prepare if ending == "crash" else None,
            )
            servo.compile()
            if ending == "crash":  # without a tick of the loop, apply a force first
                DeviceCaller(device).write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
            servo.start()
            if ending == "stop_word":
                run_for(servo, 100)
                assert any(bench.displayed())
                servo.stop()
            end = servo.join(30.0)
            assert end is not None
            assert end.ending == {"last_tick": FINISHED, "stop_word": STOPPED, "crash": CRASHED}[ending]
            assert not any(bench.displayed())
            if ending != "crash":
                assert find_last_force(servo) > 0.0
            servo.close()

    def test_opening_is_refused_by_name(self, bench: Bench) -> None:
        """A device that is absent, busy or forbidden raises its error, and opens after the cause is removed."""
        for case in set(REFUSALS) - set(bench.cannot):
            bench.make(case)
            with pytest.raises(bench.refusals[case]) as caught:
                bench.open()
            assert len(str(caught.value)) > 20, "names the fault and the remedy"
            assert type(caught.value) is bench.refusals[case], case
            bench.mend()
            bench.open().close()

    def test_failure_in_use_is_reported_and_survived(self, bench: Bench) -> None:
        """A read of a failed device returns the failure's status within `patience_s`.

        `stop` and `close` raise nothing and remove the force, and the device opens again after it is mended.
        """
        for case in set(FAULTS) - set(bench.cannot):
            device = bench.open()
            servo = DeviceCaller(device)
            servo.read()
            servo.write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
            bench.make(case)
            assert find_first_failure(servo, bench.patience_s) == FAULTS[case], case
            device.stop()
            device.close()
            assert not any(bench.displayed()), case
            bench.mend()
            with bench.open() as reopened:
                assert DeviceCaller(reopened).read()[0] in (OK, STALE)

    def test_servo_ends_with_a_failing_device(self, bench: Bench) -> None:
        """A device that fails under the servo ends the loop with its status and zero force."""
        for case in set(FAULTS) - set(bench.cannot):
            with bench.open() as device:
                servo = ServoThread([device], make_pulling_tuning(), RATE_HZ)
                servo.compile()
                servo.start()
                run_for(servo, 100)
                until = time.monotonic() + 30.0  # on a busy machine a withheld force fades in again
                while math.hypot(*bench.displayed()) <= 0.5:
                    assert servo.is_running and time.monotonic() < until, case
                    servo.records.wait()
                bench.make(case)
                end = servo.join(30.0)
                assert end is not None
                assert end.status == FAULTS[case]
                assert end.ending in (READ_FAILED, WRITE_FAILED)
                assert not any(bench.displayed()), case
                servo.close()
            bench.mend()


def run_for(servo: ServoThread, ticks: int) -> None:
    """Wait until a loop has run `ticks` ticks; fail if it ends before, because no further record would arrive."""
    while servo.ticks < ticks:
        assert servo.is_running, f"the loop ended after {servo.ticks} ticks of {ticks}"
        servo.records.wait()


def find_first_failure(servo: DeviceCaller, patience_s: float) -> int:
    """Return the status of the first failed read, or of the last read within `patience_s`."""
    until = time.monotonic() + patience_s
    while (status := servo.read()[0]) >= 0 and time.monotonic() < until:
        pass
    return status


def fail_to_prepare() -> Callable[[], None]:
    raise RuntimeError("refused")


def find_last_force(servo: ServoThread) -> float:
    """Return the largest norm (N) of the force in the last ten ticks: after a stall a ramp starts from zero."""
    out = np.empty((4096, RECORD_SIZE))
    records = out[: servo.records.take(out)]
    return float(np.linalg.norm(records[-10:, AT.force : AT.force + 3], axis=1).max())
