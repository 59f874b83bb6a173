"""Driver in a separate package: a fingertip that follows a Lissajous figure above the origin and displays no force.

A driver is a module with `Options`, the keys of a rig's [device] table, and `open_device(options, rate_hz)`, which
returns a `Device`. The servo loop calls two C functions with a handle; here numba compiles them from Python, and the
handle is the address of an array that they share with the device. They must not wait, allocate or raise.
"""

from __future__ import annotations

from typing import Annotated

import numba
import numpy as np
from numba import carray, types

from softfinger.config.limits import COORDINATE_M, MOTION_FREQUENCY_HZ
from softfinger.config.schema import Coordinate, Table, doc, within
from softfinger.drivers.base import OK, WITHHELD, Device, DeviceInfo, DeviceIO

Frequency = Annotated[float, within(MOTION_FREQUENCY_HZ, "cycles per second")]

# Indices of the block behind the handle.
READS, PERIOD, ARMED, HEIGHT, AMPLITUDE, HZ, WRENCH, SIZE = 0, 1, 2, 3, 4, 7, 10, 16

SIGNATURE = types.int64(types.CPointer(types.float64), types.CPointer(types.float64))
"""The handle is an int64 to the loop; a pointer is the same to the processor."""


class Options(Table, frozen=True, kw_only=True):
    """Keys of a rig's [device] table with `driver = "lissajous"`."""

    amplitude_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], doc("half the width along x, y, z")] = (
        0.01, 0.01, 0.0,
    )  # fmt: skip
    hz: Annotated[tuple[Frequency, Frequency, Frequency], doc("cycles per second along x, y, z")] = (0.5, 0.75, 1.0)
    height_m: Annotated[float, within(COORDINATE_M, "height of its centre", 0.01)] = 0.01


@numba.cfunc(SIGNATURE, error_model="numpy")
def _read(handle, sample):
    block = carray(handle, SIZE)
    time = block[READS] * block[PERIOD]
    block[READS] += 1.0
    for i in range(3):
        sample[i] = block[AMPLITUDE + i] * np.sin(2.0 * np.pi * block[HZ + i] * time)
        sample[4 + i] = 0.0
    sample[2] += block[HEIGHT]
    sample[3] = 1.0
    sample[7] = time
    sample[8] = sample[9] = 0.0
    return OK


@numba.cfunc(SIGNATURE, error_model="numpy")
def _write(handle, wrench):
    block = carray(handle, SIZE)
    force = False
    for i in range(6):
        force = force or wrench[i] != 0.0
    if block[ARMED] == 0.0:
        return WITHHELD if force else OK
    for i in range(6):
        block[WRENCH + i] = wrench[i]
    return OK


class Lissajous(Device):
    """The figure as a device; `felt` is the current wrench."""

    def __init__(self, options: Options, rate_hz: float) -> None:
        self._block = np.zeros(SIZE)
        self._block[[PERIOD, ARMED, HEIGHT]] = 1.0 / rate_hz, 1.0, options.height_m
        self._block[AMPLITUDE : AMPLITUDE + 3] = options.amplitude_m
        self._block[HZ : HZ + 3] = options.hz
        low, high = (tuple(sign * abs(a) for a in options.amplitude_m) for sign in (-1.0, 1.0))
        self.info = DeviceInfo(
            name="lissajous",
            sensed_dof=3,
            actuated_dof=3,
            force_max_n=10.0,
            torque_max_nm=1.0,
            stiffness_max_n_per_m=1e4,
            damping_max_ns_per_m=100.0,
            workspace_min_m=(low[0], low[1], low[2] + options.height_m),
            workspace_max_m=(high[0], high[1], high[2] + options.height_m),
            own_clock=True,  # read number n is n periods after the first, for any clock
        )

    def io(self) -> DeviceIO:
        return DeviceIO(_read.address, _write.address, self._block.ctypes.data)

    def stop(self) -> None:
        self._block[ARMED] = 0.0
        self._block[WRENCH : WRENCH + 6] = 0.0

    def close(self) -> None:
        self.stop()

    @property
    def felt(self) -> tuple[float, ...]:
        return tuple(self._block[WRENCH : WRENCH + 6].tolist())


def open_device(options: Options, rate_hz: float) -> Lissajous:
    """Open the figure; it cannot fail."""
    return Lissajous(options, rate_hz)
