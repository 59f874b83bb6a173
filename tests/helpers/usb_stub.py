"""Stub of libusb with Falcons, compiled by the test and loaded by pyusb's loader."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import usb.backend.libusb1

from helpers.c_stub import compiled
from helpers.rig_files import rig_options
from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.device import Falcon, open_device
from softfinger.server.driver_contract import RATE_HZ, Bench

SOURCE = Path(__file__).parents[1] / "stubs" / "usb.c"
SONAME = "libusb-1.0.so.0"

Counts = ctypes.c_int64 * 9


class UsbStub:
    """Variables of the stub: `stub["steps"]` of the first Falcon, `stub[1, "steps"]` of the second."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._library = call = ctypes.CDLL(str(path))  # the same file that pyusb loads, so both share its state
        call.stub_get.restype = ctypes.c_double
        call.stub_get.argtypes = [ctypes.c_int, ctypes.c_char_p]
        call.stub_set.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_double]
        call.stub_fuzz.argtypes = [*(ctypes.c_int64,) * 4, ctypes.c_int, ctypes.c_int, ctypes.POINTER(ctypes.c_int64)]

    def __getitem__(self, name: str | tuple[int, str]) -> float:
        number, knob = (0, name) if isinstance(name, str) else name
        return float(self._library.stub_get(number, knob.encode()))

    def __setitem__(self, name: str | tuple[int, str], value: float) -> None:
        number, knob = (0, name) if isinstance(name, str) else name
        self._library.stub_set(number, knob.encode(), value)

    def update(self, **values: float) -> None:
        for name, value in values.items():
            self[name] = value
        self.place()

    def reset(self) -> None:
        self._library.stub_reset()
        self.place()
        self.place(1)

    def place(self, number: int = 0) -> None:
        """Move the knob to the position of the hand."""
        self._library.stub_place(number)

    def state(self, number: int = 0) -> np.ndarray:
        """Return the present force (N) on the hand and position (m) of the knob in the world's frame, (6,)."""
        out = np.zeros(6)
        self._library.stub_state(number, out.ctypes.data_as(ctypes.c_void_p))
        return out

    def motors(self, number: int = 0) -> tuple[float, float, float]:
        """Return the present motor counts."""
        return self[number, "m0"], self[number, "m1"], self[number, "m2"]

    def log(self) -> np.ndarray:
        """Return (n, 7) per packet since `logged`: force and position like `state`, and if the host waited."""
        out = np.zeros((int(self["logged"]), 7))
        self._library.stub_log(0, out.ctypes.data_as(ctypes.c_void_p), len(out))
        return out

    def times(self) -> np.ndarray:
        """Return the arrival times of these packets, s of the monotonic clock (n,)."""
        out = np.zeros(int(self["logged"]))
        self._library.stub_times(0, out.ctypes.data_as(ctypes.c_void_p), len(out))
        return out

    def busy(self) -> bool:
        """Return whether a thread is handling events."""
        return bool(self._library.stub_busy())

    def fuzz(self, device: Falcon, ticks: int) -> list[int]:
        """Run this number of ticks in C against corrupted replies; return the stub's counts."""
        io, counts = device.io(), Counts()
        self._library.stub_fuzz(io.read, io.write, io.handle, io.handle + 8 * AT.counts, SAMPLE_SIZE, ticks, counts)
        return list(counts)


def word(device: Falcon, place: int) -> int:
    """Return an element of the device's block; the handle is its address."""
    return int(ctypes.c_int64.from_address(device.io().handle + 8 * place).value)


@contextmanager
def in_place_of_libusb(path: Path) -> Iterator[None]:
    """Let pyusb's loader find this library, and return it as pyusb's backend."""
    module = usb.backend.libusb1
    before = module._lib, module._lib_object
    module._lib_object = None
    assert module.get_backend(find_library=lambda _: str(path)) is not None
    try:
        yield
    finally:
        if before[0] is not None and before[0]._name != str(path):
            gc.collect()  # pyusb's objects release themselves through the module's current library
        module._lib, module._lib_object = before[0] or module._lib, before[1]


@contextmanager
def attached() -> Iterator[UsbStub]:
    """A homed Falcon with running firmware and a resting hand at 20 mm height."""
    library = compiled(SOURCE, SONAME)  # without a soname: libusb itself may be loaded later
    stub = UsbStub(library)
    stub.reset()
    with in_place_of_libusb(library):
        yield stub
    stub.reset()


@pytest.fixture
def stub() -> Iterator[UsbStub]:
    with attached() as stub:
        yield stub


def options(**changes: Any) -> Any:
    """Return the [device] table of the shipped rig with changed keys and a known gain of the motors."""
    return rig_options("falcon", **{"counts_per_nm": 10000.0, **changes})


class FalconBench(Bench):
    """Bench with a Falcon on the stub."""

    # Half a motor count at each leg is 4 mN at the knob; it moves for a millisecond before the reading.
    force_step_n = 0.01
    patience_s = 10.0

    def __init__(self, stub: UsbStub) -> None:
        self.stub = stub

    def open(self, **changes: Any) -> Falcon:
        device = open_device(options(**changes), RATE_HZ)
        device.arm()
        return device

    def displayed(self) -> tuple[float, ...]:
        return tuple(self.stub.state()[:3])

    def make(self, case: str) -> None:
        knobs = {"not_found": "attached", "busy": "held", "permission": "forbidden", "lost": "unplugged"}
        if case == "timeout":
            self.stub["mute_at"] = 0.0
        else:
            self.stub[knobs[case]] = 0.0 if case == "not_found" else 1.0

    def mend(self) -> None:
        self.stub.reset()
