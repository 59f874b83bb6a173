"""Stub of 3D Systems' library, compiled by the test."""

import ctypes
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from helpers.c_stub import CStub, compiled
from helpers.waits import until
from softfinger.drivers import open_devices
from softfinger.drivers.openhaptics import device as openhaptics
from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.driver_contract import RATE_HZ, Bench

SOURCE = Path(__file__).parents[1] / "stubs" / "hd.c"
ROWS = 1 << 16
ROW = np.dtype([("ns", "<i8"), ("device", "<i8"), ("force", "<f8", 3), ("torque", "<f8", 3)])
JOURNAL = np.dtype([("count", "<i8"), ("pad", "<i8", 7), ("row", ROW, ROWS)])


class HdStub(CStub):
    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._library.stub_journal.restype = ctypes.c_void_p

    def push(self, code: int, device: int = -1, many: int = 1) -> None:
        """Push an error onto the stack, of one device or of none."""
        self._library.stub_push(code, device, many)

    def wrench(self, device: int = 0) -> tuple[float, ...]:
        """Return the present force of the motors in the library's frame: N, mN m."""
        out = (ctypes.c_double * 6)()
        self._library.stub_force(device, out)
        return tuple(out)

    def journal(self) -> NDArray[Any]:
        """Return the rows so far, in order of time: the motors' force in each tick, in the library's frame."""
        memory = (ctypes.c_char * JOURNAL.itemsize).from_address(self._library.stub_journal())
        journal = np.frombuffer(memory, JOURNAL)[0]
        count, rows = int(journal["count"]), journal["row"]
        return rows[:count].copy() if count <= ROWS else np.roll(rows, -(count % ROWS))

    def after(self, ticks: int) -> None:
        """Wait for this number of ticks of the library's thread; fails if it does not run."""
        until, end = self["ticks"] + ticks, time.monotonic() + 10.0
        while self["ticks"] < until and self["running"]:
            assert time.monotonic() < end
            time.sleep(0.0002)


@pytest.fixture(scope="session")
def hd_library() -> Path:
    return compiled(SOURCE, "libHD.so.3.4.0", "-pthread")


@pytest.fixture
def hd(hd_library: Path) -> Iterator[HdStub]:
    """A Touch with the stub's default settings and a resting hand 20 mm above the centre."""
    stub = HdStub(hd_library)
    stub.reset()
    yield stub
    is_left_open = stub["running"]
    open_devices.close_all()  # the next test uses the same library
    until(lambda: not stub["running"], message="the end of the library's thread")
    stub.reset()
    assert not is_left_open, "the test has left its device open"


PORT = SystemDevice("serial", 0x2988, 0x0302, "Geomagic Touch", "", "/dev/ttyACM0")


class TouchBench(Bench):
    def __init__(self, stub: HdStub, monkeypatch: pytest.MonkeyPatch) -> None:
        self.stub = stub
        self._patch = monkeypatch
        self.ports(())

    def ports(self, ports: tuple[SystemDevice, ...], permitted: bool = True) -> None:
        """Devices listed by the system, and whether this user may open them."""
        self._patch.setattr(discovery, "list_attached", lambda: list(ports))
        self._patch.setattr(discovery, "is_permitted", lambda node: permitted)

    patience_s = 5.0  # nothing waits for the library's thread, and this machine may delay any thread

    def options(self, **options: Any) -> openhaptics.Options:
        # The age of a force counts real time, and a busy machine may delay the next exchange of a test.
        return openhaptics.Options(**{"library_file": str(self.stub.path), "force_age_max_s": 0.1, **options})

    def open_unarmed(self, **options: Any) -> openhaptics.OpenHaptics:
        return openhaptics.open_device(self.options(**options), RATE_HZ)

    def open(self, **options: Any) -> openhaptics.OpenHaptics:
        device = self.open_unarmed(**options)
        try:
            device.arm()
        except BaseException:  # for example because the machine gave the library's thread no time
            device.close()
            raise
        return device

    def displayed(self) -> tuple[float, ...]:
        self.stub.after(2)  # a force reaches the motors at the end of the next frame
        fx, fy, fz, tx, ty, tz = self.stub.wrench()
        return fx, -fz, fy, 1e-3 * tx, -1e-3 * tz, 1e-3 * ty

    def make(self, case: str) -> None:
        if case == "permission":
            self.ports((PORT,), permitted=False)
        knobs = {"busy": {"held": 1}, "lost": {"unplugged": 1}, "timeout": {"hang_at": 0}}
        self.stub.update(**knobs.get(case, {"devices": 0}))

    def mend(self) -> None:
        self.stub.reset()
        self.ports(())


@pytest.fixture
def touch(hd: HdStub, monkeypatch: pytest.MonkeyPatch) -> TouchBench:
    return TouchBench(hd, monkeypatch)
