"""What every driver must keep, as one class of tests.

A test module subclasses `DriverContract` and gives it a fixture `device`: an open, armed device.
The C functions are called as the servo calls them, through their addresses.
"""

from __future__ import annotations

import ctypes
import math

import pytest

from softfinger.drivers.base import END, OK, SAMPLE_SIZE, STALE, Device

Function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))


class Servo:
    """Calls a device's C functions."""

    def __init__(self, device: Device) -> None:
        self._io = device.io()
        self._read, self._write = Function(self._io.read), Function(self._io.write)

    def read(self) -> tuple[int, list[float]]:
        sample = (ctypes.c_double * SAMPLE_SIZE)(*[math.nan] * SAMPLE_SIZE)
        return self._read(self._io.handle, sample), list(sample)

    def write(self, *wrench: float) -> int:
        return self._write(self._io.handle, (ctypes.c_double * 6)(*wrench))


class DriverContract:
    """Run by every driver over a device that answers."""

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

    def test_write_is_taken_while_armed(self, device: Device) -> None:
        """An open device takes a small force."""
        servo = Servo(device)
        servo.read()
        assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, STALE)

    def test_stop_may_be_repeated_and_disarms(self, device: Device) -> None:
        """After stop, however often, a force is not taken in full and reads go on."""
        servo = Servo(device)
        servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
        device.stop()
        device.stop()
        assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) != OK
        assert servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, STALE)
        assert servo.read()[0] in (OK, STALE, END)

    def test_close_may_be_repeated(self, device: Device) -> None:
        """Close after stop and after close does nothing and raises nothing."""
        device.stop()
        device.close()
        device.close()

    def test_leaving_the_context_closes_after_an_error(self, device: Device) -> None:
        """An exception leaves the context unchanged, with the device disarmed."""
        servo = Servo(device)
        with pytest.raises(ZeroDivisionError), device:
            raise ZeroDivisionError
        assert servo.write(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) != OK
