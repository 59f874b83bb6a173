"""What every driver must keep, as one class of tests for pytest; of this package's drivers and of any other's.

A test module subclasses `DriverContract` and gives it a fixture `bench`: what stands behind the driver, which opens
the device and does to it what happens to devices. The C functions are called as the servo calls them.
docs/devices/writing-a-driver.md has an example. Only tests import this module: pytest is no requirement of the package.
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
from softfinger.server.loop.servo_thread import Servo as Loop
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
"""What may keep a device from opening, and the error that says so."""

FAULTS: Final[Mapping[str, int]] = {"lost": LOST, "timeout": TIMEOUT}
"""What may happen to an open device, and the status of the next read."""


class Servo:
    """Calls a device's C functions, after arming it unless the case is about the time before."""

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
    """What stands behind a driver. `cannot` gives the reason for each case of REFUSALS and FAULTS that there is not."""

    cannot: ClassVar[Mapping[str, str]] = {}
    refusals: ClassVar[Mapping[str, type[HapticError]]] = REFUSALS
    force_step_n: ClassVar[float] = 1e-12
    """How far a displayed force may be from the one written: a device's own steps; here rounding alone."""
    patience_s: ClassVar[float] = 0.0
    """Time in which a failure has to be told; 0: by the next read. More for a device that is not waited for."""

    @abstractmethod
    def open(self) -> Device:
        """Open a device; whoever exchanges with it arms it."""

    @abstractmethod
    def displayed(self) -> tuple[float, ...]:
        """The wrench on the hand now, world frame, as the device has it and not as the driver says."""

    def part(self, *force: float) -> tuple[float, ...]:
        """Of a force (3,) N what the device has motors for: all of it, but for one with fewer than three."""
        return force

    def make(self, case: str) -> None:
        """From now on: a case of REFUSALS or FAULTS."""
        raise NotImplementedError(case)

    def mend(self) -> None:
        """Undo `make`."""
        raise NotImplementedError


PULL: Final = {
    "fingertip": {"radius_m": 0.01},
    "object": [{"name": "floor", "shape": "plane", "material": {"stiffness_n_per_m": 1000.0}}],
    "effect": [{"kind": "constant_force", "force_n": [0.6, 0.0, 0.8]}],
}
"""A scene that pulls with 1 N wherever the finger is, and pushes up from below z = 0."""


def pulling() -> Tuning:
    """The scene of `PULL`, and a guard that ramps in within 10 ms."""
    return make_tuning(load_scene(PULL), load_rig("replay", {"guard.ramp_s": 0.01}).guard)


class DriverContract:
    """Run by every driver over a device that answers, and then over one that does not."""

    @pytest.fixture
    def device(self, bench: Bench) -> Iterator[Device]:
        with bench.open() as opened:
            yield opened

    def test_every_case_is_answered(self, bench: Bench) -> None:
        """For each way to be refused or to fail, the bench can make it or says why it cannot be."""
        assert set(bench.cannot) <= {*REFUSALS, *FAULTS}
        assert set(bench.refusals) <= set(REFUSALS)
        assert all(len(reason) > 10 for reason in bench.cannot.values())
        assert {*bench.refusals} - {*bench.cannot} == {*REFUSALS} - {*bench.cannot}

    def test_info_is_usable(self, device: Device) -> None:
        """The limits are finite and not negative, and the workspace is not inside out."""
        info = device.info
        assert info.name
        assert 1 <= info.sensed_dof <= 6
        assert 0 <= info.actuated_dof <= 6
        for limit in (info.force_max_n, info.torque_max_nm, info.stiffness_max_n_per_m, info.damping_max_ns_per_m):
            assert math.isfinite(limit)
            assert limit >= 0.0
        assert all(low <= high for low, high in zip(info.workspace_min_m, info.workspace_max_m, strict=True))

    def test_addresses_stay(self, device: Device) -> None:
        """However often they are asked for, the addresses are the same, and there are three."""
        assert device.io() == device.io()
        assert all(device.io())

    def test_read_fills_the_whole_sample(self, device: Device) -> None:
        """A good read leaves finite numbers in every place and a unit quaternion."""
        status, sample = Servo(device).read()
        assert status in (OK, STALE)
        assert all(math.isfinite(value) for value in sample)
        assert math.hypot(*sample[3:7]) == pytest.approx(1.0, abs=1e-9)  # rounding of a normalisation

    def test_device_time_does_not_run_back(self, device: Device) -> None:
        """Device time never decreases from read to read."""
        servo = Servo(device)
        times = [servo.read()[1][7] for _ in range(20)]
        assert times == sorted(times)

    def test_counts_never_fall(self, device: Device) -> None:
        """Counters have names, are whole numbers from 0 up, and only ever rise; where there are any, one follows
        the exchanges."""
        servo = Servo(device)
        before = device.counts()
        for _ in range(20):
            servo.read()
            servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        after = device.counts()
        assert before.keys() == after.keys()
        assert all(type(value) is int for value in after.values())
        assert all(0 <= before[name] <= after[name] for name in before)
        assert not after or after != before

    def test_write_is_taken_while_armed(self, device: Device, bench: Bench) -> None:
        """An open device takes a small force, and displays it in the world frame."""
        servo = Servo(device)
        servo.read()
        assert servo.write(0.1, 0.2, 0.3, 0.0, 0.0, 0.0) in (OK, STALE)
        assert bench.displayed()[:3] == pytest.approx(bench.part(0.1, 0.2, 0.3), abs=bench.force_step_n)

    def test_arming_is_the_last_act_before_the_first_tick(self, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        """A device waits as long as it takes until the servo's thread arms it, once, and is exchanged with at once; it
        fails neither before nor after, and the force comes."""
        with bench.open() as device:
            arm, acts = device.arm, []

            def noted() -> None:
                arm()
                acts.append(("armed", threading.get_native_id()))

            def slow() -> Callable[[], None]:
                time.sleep(1.0)  # as long as real-time settings take, and longer than any watchdog
                acts.append(("prepared", threading.get_native_id()))
                return lambda: None

            monkeypatch.setattr(device, "arm", noted)
            servo = Loop([device], pulling(), RATE_HZ, 100, slow)
            servo.compile()
            servo.start()
            ended = servo.join(30.0)
            assert ended is not None
            assert (ended.ending, ended.error) == (FINISHED, None)
            assert [act for act, _ in acts] == ["prepared", "armed"]
            assert acts[0][1] == acts[1][1]
            assert last_force(servo) > 0.0  # of 1 N; where the machine stood still, along the ramp anew
            servo.close()

    def test_a_device_that_is_not_armed_displays_nothing(self, bench: Bench) -> None:
        """Opened and stopped without ever having been armed: no force, and no error."""
        with bench.open() as device:
            device.stop()
            assert not any(bench.displayed())

    def test_stop_may_be_repeated_and_disarms(self, device: Device) -> None:
        """After stop, however often, a force is not taken in full and reads go on."""
        servo = Servo(device)
        servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
        device.stop()
        device.stop()
        assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) != OK
        assert servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, STALE, WITHHELD)
        assert servo.read()[0] in (OK, STALE, END, WITHHELD)

    def test_close_may_be_repeated(self, device: Device) -> None:
        """Close after stop and after close does nothing and raises nothing."""
        device.stop()
        device.close()
        device.close()

    def test_a_closed_device_can_be_opened_again(self, device: Device, bench: Bench) -> None:
        """Closing lets go of the device: it opens again, armed."""
        device.close()
        with bench.open() as again:
            servo = Servo(again)
            assert servo.read()[0] in (OK, STALE)
            assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, STALE)
            assert math.hypot(*bench.displayed()) > 0.0

    @pytest.mark.parametrize("way", ["stop", "close", "error"])
    def test_no_force_is_left_without_a_servo(self, way: str, bench: Bench) -> None:
        """Stopped, closed or left by an exception, which goes through unchanged: the force that was on is off."""
        device = bench.open()
        servo = Servo(device)
        servo.read()
        servo.write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
        assert math.hypot(*bench.displayed()) > 0.0
        if way == "stop":
            device.stop()
        elif way == "close":
            device.close()
        else:
            with pytest.raises(ZeroDivisionError), device:
                raise ZeroDivisionError
        assert not any(bench.displayed())
        device.close()

    @pytest.mark.parametrize("way", ["last_tick", "stop_word", "crash"])
    def test_no_force_is_left_after_a_servo(self, way: str, bench: Bench) -> None:
        """After the last tick, a stop, or an exception in the servo's thread, the force that was on is off."""
        with bench.open() as device:
            servo = Loop(
                [device], pulling(), RATE_HZ, 100 if way == "last_tick" else None, failing if way == "crash" else None
            )
            servo.compile()
            if way == "crash":  # there is no tick, so the force comes from before
                Servo(device).write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
            servo.start()
            if way == "stop_word":
                run_for(servo, 100)
                assert any(bench.displayed())
                servo.stop()
            ended = servo.join(30.0)
            assert ended is not None
            assert ended.ending == {"last_tick": FINISHED, "stop_word": STOPPED, "crash": CRASHED}[way]
            assert not any(bench.displayed())
            if way != "crash":
                assert last_force(servo) > 0.0  # of 1 N; where the machine stood still, along the ramp anew
            servo.close()

    def test_opening_is_refused_by_name(self, bench: Bench) -> None:
        """A device that is absent, held or forbidden gives its own error, and opens once that is over."""
        for case in set(REFUSALS) - set(bench.cannot):
            bench.make(case)
            with pytest.raises(bench.refusals[case]) as caught:
                bench.open()
            assert len(str(caught.value)) > 20, "says what is wrong and what to do"
            assert type(caught.value) is bench.refusals[case], case
            bench.mend()
            bench.open().close()

    def test_failure_in_use_is_told_and_survived(self, bench: Bench) -> None:
        """A read of a device that fails gives its status, within the bench's patience; stop and close raise nothing, no
        force is left, and the device opens again once it is back."""
        for case in set(FAULTS) - set(bench.cannot):
            device = bench.open()
            servo = Servo(device)
            servo.read()
            servo.write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
            bench.make(case)
            assert first_failure(servo, bench.patience_s) == FAULTS[case], case
            device.stop()
            device.close()
            assert not any(bench.displayed()), case
            bench.mend()
            with bench.open() as again:
                assert Servo(again).read()[0] in (OK, STALE)

    def test_servo_ends_with_a_failing_device(self, bench: Bench) -> None:
        """A device that fails under the servo ends the loop with its status and without force."""
        for case in set(FAULTS) - set(bench.cannot):
            with bench.open() as device:
                servo = Loop([device], pulling(), RATE_HZ)
                servo.compile()
                servo.start()
                run_for(servo, 100)
                until = time.monotonic() + 30.0  # on a busy machine a withheld force fades in again
                while math.hypot(*bench.displayed()) <= 0.5:
                    assert servo.running and time.monotonic() < until, case
                    servo.records.wait()
                bench.make(case)
                ended = servo.join(30.0)
                assert ended is not None
                assert ended.status == FAULTS[case]
                assert ended.ending in (READ_FAILED, WRITE_FAILED)
                assert not any(bench.displayed()), case
                servo.close()
            bench.mend()


def run_for(servo: Loop, ticks: int) -> None:
    """Wait until a loop has done so many ticks; fails where it ends before, after which no record comes."""
    while servo.ticks < ticks:
        assert servo.running, f"the loop ended after {servo.ticks} ticks of {ticks}"
        servo.records.wait()


def first_failure(servo: Servo, patience_s: float) -> int:
    """Status of the first read that fails, or of the last one in that time."""
    until = time.monotonic() + patience_s
    while (status := servo.read()[0]) >= 0 and time.monotonic() < until:
        pass
    return status


def failing() -> Callable[[], None]:
    raise RuntimeError("refused")


def last_force(servo: Loop) -> float:
    """Norm (N) of the force of the last tick."""
    out = np.empty((4096, RECORD_SIZE))
    records = out[: servo.records.take(out)]
    return float(np.linalg.norm(records[-1, AT.force : AT.force + 3]))
