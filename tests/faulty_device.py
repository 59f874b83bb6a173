"""A device that breaks on demand, behind the same C functions as any other driver.

It presses a fingertip 1 mm into the plane z = 0 and drags it to and fro; at read `at` it does what
`fault` says. Every wrench written is kept.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec
import numpy as np
from numba import types

from softfinger.drivers.base import LOST, OK, PROTOCOL, SAMPLE_SIZE, TIMEOUT, Device, DeviceInfo, DeviceIO
from softfinger.proxy.kernels.jit import c_function
from softfinger.proxy.kernels.memory import float64_at, int64_at

Fault = Literal["none", "lost", "timeout", "protocol", "write_lost", "nan", "zero_quaternion", "stall", "far"]
FAULTS: tuple[Fault, ...] = (
    "none", "lost", "timeout", "protocol", "write_lost", "nan", "zero_quaternion", "stall", "far",
)  # fmt: skip

AT, FAULT, READS, WRITES, ARMED, KEPT, STALL_US = range(7)
ROOM = 100_000

usleep = types.ExternalFunction("usleep", types.int32(types.uint32))


@c_function(types.int64(types.int64, types.CPointer(types.float64)))
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    number = word[READS]
    word[READS] = number + 1
    for i in range(SAMPLE_SIZE):
        sample[i] = 0.0
    sample[0] = 0.005 * np.sin(0.02 * number)
    sample[2] = 0.009
    sample[3] = 1.0
    sample[7] = number * 0.001
    if number != word[AT]:
        return OK
    fault = word[FAULT]
    if fault == 1:
        return LOST
    if fault == 2:
        return TIMEOUT
    if fault == 3:
        return PROTOCOL
    if fault == 5:
        sample[1] = np.nan
    elif fault == 6:
        sample[3] = 0.0
    elif fault == 7:
        usleep(word[STALL_US])
    elif fault == 8:
        sample[0] = 1e300
    return OK


@c_function(types.int64(types.int64, types.CPointer(types.float64)))
def _write(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    if word[ARMED] == 0 or word[WRITES] >= ROOM:
        return OK
    kept = float64_at(word[KEPT] + 48 * word[WRITES])
    for i in range(6):
        kept[i] = wrench[i]
    word[WRITES] += 1
    if word[FAULT] == 4 and word[READS] > word[AT]:
        return LOST
    return OK


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    fault: Fault = "none"
    at: int = 100
    stall_us: int = 3500
    own_clock: bool = False


class FaultyDevice(Device):
    def __init__(self, options: Options) -> None:
        self._word = np.zeros(8, np.int64)
        self._kept = np.zeros((ROOM, 6))
        self._word[[AT, FAULT, ARMED, KEPT, STALL_US]] = (
            options.at, FAULTS.index(options.fault), 1, self._kept.ctypes.data, options.stall_us,
        )  # fmt: skip
        far = (1.0, 1.0, 1.0)
        self.info = DeviceInfo("faulty", 6, 6, 1e3, 1e2, 1e6, 1e3, (-1.0, -1.0, -1.0), far, options.own_clock)

    def io(self) -> DeviceIO:
        return DeviceIO(_read.address, _write.address, self._word.ctypes.data)

    def stop(self) -> None:
        if self._word[ARMED]:
            zero = np.zeros(6)
            _write.ctypes(self._word.ctypes.data, zero.ctypes.data_as(_write.ctypes.argtypes[1]))
            self._word[ARMED] = 0

    def close(self) -> None:
        self.stop()

    @property
    def wrenches(self) -> np.ndarray:
        """Every wrench written (k, 6), oldest first."""
        return self._kept[: self._word[WRITES]].copy()


def open_device(options: Options, rate_hz: float) -> FaultyDevice:
    return FaultyDevice(options)
