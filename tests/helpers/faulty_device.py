"""Device that fails on demand, behind the same C functions as any other driver.

It presses a fingertip 1 mm into the plane z = 0 and drags it back and forth; `fault` acts on `count` reads from read
`at` on. Every wrench written while it is armed is recorded.
"""

import threading
from typing import Any, Literal, get_args

import msgspec
import numpy as np
from numba import types

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.drivers import base, registry
from softfinger.drivers.base import HELD, LOST, OK, PROTOCOL, TIMEOUT, WITHHELD, Device, DeviceInfo, DeviceIO
from softfinger.proxy.kernels.jit.decorators import c_function
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at

Fault = Literal[
    "none", "lost", "timeout", "protocol", "write_lost", "nan", "zero_quaternion", "stall", "far",
    "withheld_read", "withheld_write", "stall_and_jump", "hang", "held", "unknown_read", "unknown_write",
    "jump", "jumps", "frozen", "lost_hang", "write_lost_hang",
]  # fmt: skip
FAULTS: tuple[Fault, ...] = get_args(Fault)

AT, FAULT, READS, WRITES, ARMED, KEPT, STALL_US, COUNT, FREE, JUMP_UM, WRITE_LOST = range(11)
ROOM = 100_000
UNKNOWN = HELD + 1
"""A status that no driver uses."""

usleep = types.ExternalFunction("usleep", types.int32(types.uint32))


@c_function(types.int64(types.int64, types.CPointer(types.float64)))
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    number = word[READS]
    word[READS] = number + 1
    for i in range(base.SAMPLE_SIZE):
        sample[i] = 0.0
    fault = word[FAULT]
    sample[0] = 0.005 * np.sin(0.02 * number)
    sample[2] = 0.002 if fault in (11, 13) and number >= word[AT] else 0.009
    sample[3] = 1.0
    sample[7] = number * 0.001
    if not word[AT] <= number < word[AT] + word[COUNT]:
        return OK
    if fault in (1, 19):
        return LOST
    if fault == 2:
        return TIMEOUT
    if fault == 3:
        return PROTOCOL
    if fault == 5:
        sample[1] = np.nan
    elif fault == 6:
        sample[3] = 0.0
    elif fault in (7, 11):
        usleep(word[STALL_US])
    elif fault == 8:
        sample[0] = 1e300
    elif fault == 9:
        return WITHHELD
    elif fault == 14:
        return UNKNOWN
    elif fault == 16 or (fault == 17 and number % 2 == 0):
        sample[1] = 1e-6 * word[JUMP_UM]
    elif fault == 18:
        sample[0] = 0.005 * np.sin(0.02 * word[AT])
    elif fault == 12:
        while word[FREE] == 0:
            usleep(1000)
    return OK


@c_function(types.int64(types.int64, types.CPointer(types.float64)))
def _write(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    if word[ARMED] == 0 or word[WRITES] >= ROOM:
        return OK
    if word[FAULT] in (19, 20) and word[READS] > word[AT]:  # every write hangs after the failure
        if word[FAULT] == 20 and word[WRITE_LOST] == 0:
            word[WRITE_LOST] = 1
            return LOST
        while word[FREE] == 0:
            usleep(1000)
        return OK
    wrenches = float64_at(word[KEPT] + 48 * word[WRITES])
    for i in range(6):
        wrenches[i] = wrench[i]
    word[WRITES] += 1
    if word[FAULT] == 4 and word[READS] > word[AT]:
        return LOST
    if word[FAULT] == 10 and word[AT] < word[READS] <= word[AT] + word[COUNT]:
        for i in range(6):
            wrenches[i] = 0.0
        return WITHHELD
    if word[FAULT] == 13 and word[AT] < word[READS] <= word[AT] + word[COUNT]:
        for i in range(6):
            wrenches[i] = float64_at(word[KEPT] + 48 * (word[WRITES] - 2))[i]
        return HELD
    return UNKNOWN if word[FAULT] == 15 and word[READS] > word[AT] else OK


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    fault: Fault = "none"
    at: int = 100
    count: int = 1
    stall_us: int = 3500
    jump_m: float = 0.05
    own_clock: bool = False
    refuses_to_arm: bool = False
    stop_fails: bool = False


class FaultyDevice(Device):
    def __init__(self, options: Options) -> None:
        self._options = options
        self._word = np.zeros(16, np.int64)
        self._wrenches = np.zeros((ROOM, 6))
        self._word[[AT, FAULT, KEPT, STALL_US, COUNT, JUMP_UM]] = (
            options.at, FAULTS.index(options.fault), self._wrenches.ctypes.data, options.stall_us, options.count,
            round(1e6 * options.jump_m),
        )  # fmt: skip
        far = (1.0, 1.0, 1.0)
        self.info = DeviceInfo("faulty", 6, 6, 1e3, 1e2, 1e6, 1e3, (-1.0, -1.0, -1.0), far, options.own_clock)
        self.acts: list[tuple[str, int, int]] = []
        """Calls from Python: the function, the thread, and the number of reads before it."""
        self._stopped = False

    def io(self) -> DeviceIO:
        return DeviceIO(_read.address, _write.address, self._word.ctypes.data)

    def arm(self) -> None:
        self._note("arm")
        if self._options.refuses_to_arm:
            raise DeviceError("faulty: the force button is not pressed")
        self._word[ARMED] = 1

    def stop(self) -> None:
        self._note("stop")
        if self._options.stop_fails:
            raise OSError("the port has gone")
        if not self._stopped:
            self._stopped = True
            self._wrenches[self._word[WRITES]] = 0.0
            self._word[WRITES] += 1
            self._word[ARMED] = 0

    def close(self) -> None:
        self._note("close")
        self.stop()

    def fail_after(self, reads: int) -> None:
        """Cause the fault after more reads, instead of at the read of the options."""
        self._word[AT] = self._word[READS] + reads

    def release(self) -> None:
        self._word[FREE] = 1

    @property
    def wrenches(self) -> np.ndarray:
        """Wrenches on the hand (k, 6), oldest first."""
        return self._wrenches[: self._word[WRITES]].copy()

    def _note(self, act: str) -> None:
        self.acts.append((act, threading.get_native_id(), int(self._word[READS])))


class Driver:
    """Driver module that opens and stores such devices; from the index `refuses` on, it raises an error."""

    Options = Options

    def __init__(self) -> None:
        self.devices: list[FaultyDevice] = []
        self.refuses = 1000

    def open_device(self, options: Options, rate_hz: float) -> FaultyDevice:
        if len(self.devices) >= self.refuses:
            raise DeviceNotFound("faulty: not plugged in: plug it in")
        self.devices.append(FaultyDevice(options))
        return self.devices[-1]

    @property
    def device(self) -> FaultyDevice:
        return self.devices[-1]

    @property
    def pressed(self) -> bool:
        """True if the last two devices display a force now."""
        return all(len(device.wrenches) and device.wrenches[-1].any() for device in self.devices[-2:])


def registered(monkeypatch: Any) -> Driver:
    """Return a driver that rigs name `faulty`."""
    driver, load = Driver(), registry.load
    monkeypatch.setattr(registry, "load", lambda name: driver if name == "faulty" else load(name))
    return driver


def acts(device: FaultyDevice) -> list[str]:
    return [act for act, *_ in device.acts]
