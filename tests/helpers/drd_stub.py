"""Stub of Force Dimension's library, compiled by the test, and its devices on USB."""

import ctypes
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from helpers.c_stub import CStub, compiled
from softfinger.drivers.forcedimension import device as forcedimension
from softfinger.drivers.forcedimension import selection
from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.driver_contract import RATE_HZ, Bench

SOURCE = Path(__file__).parents[1] / "stubs" / "drd.c"
LOGGED = 1 << 14
"""Length of the stub's log."""
PRESSING = {"type": 34, "wrist": 1, "z": 0.0115, "az": 0.0035, "ax": 0.006, "ay": 0.012, "hz": 1.0, "turn": 0.5}
"""Once a second the hand moves 2 mm deep into the plane z = 0 with a finger of 10 mm, rolls, slides and releases."""


class Stub(CStub):
    def force(self) -> tuple[float, float, float]:
        """Return the present force of the motors in the library's frame (x towards the user, y right, z up)."""
        out = (ctypes.c_double * 3)()
        self._library.stub_force(out)
        return out[0], out[1], out[2]

    def log(self) -> NDArray[np.float64]:
        """Return the forces of the motors so far (n, 4): time (s, monotonic clock) and force (N, library's frame)."""
        out = np.zeros((LOGGED, 4))
        return out[: self._library.stub_log(out.ctypes.data_as(ctypes.c_void_p), LOGGED)]

    def busy(self) -> bool:
        return bool(self._library.stub_busy())

    def norm(self) -> float:
        return math.hypot(*self.force())


@pytest.fixture(scope="session")
def stub_library() -> Path:
    return compiled(SOURCE, "libdrd.so.3.17.5")


@pytest.fixture
def stub(stub_library: Path) -> Iterator[Stub]:
    """An omega.3 with the stub's default settings and a resting hand at 20 mm height."""
    stub = Stub(stub_library)
    stub.reset()
    yield stub
    stub.reset()


@contextmanager
def plugged_in(*products: int, nodes: Path | None, mode: int = 0o666) -> Iterator[None]:
    """Let the system list these products, with device nodes of that mode under `nodes`, for a user without
    privileges."""
    usb_devices, devices = discovery.iter_usb_devices, []
    for number, product in enumerate(products, 5):
        node = (nodes or Path("/dev/bus/usb")) / "001" / f"{number:03d}"
        devices.append(SystemDevice("usb", selection.VENDOR, product, "USB device", "", str(node)))
        if nodes is not None:
            node.parent.mkdir(exist_ok=True)
            node.touch()
            node.chmod(mode)
    discovery.iter_usb_devices = lambda: devices
    drop = os.geteuid() == 0
    if drop:
        os.seteuid(65534)  # user nobody: root may open everything
    try:
        yield
    finally:
        if drop:
            os.seteuid(0)
        discovery.iter_usb_devices = usb_devices


class OmegaBench(Bench):
    def __init__(self, stub: Stub) -> None:
        self.stub = stub
        self.forbidden = False

    def open(self, **options: Any) -> Any:
        if self.forbidden:
            with plugged_in(0x0402, nodes=self.stub.path.parent, mode=0):
                return self._open(**options)
        return self._open(**options)

    def _open(self, **options: Any) -> Any:
        device = self.open_unarmed(**options)
        device.arm()
        return device

    def open_unarmed(self, **options: Any) -> Any:
        # The watchdog counts real time, and a busy machine may delay the next exchange of a test.
        chosen = {"library_file": str(self.stub.path), "watchdog_s": 0.0, **options}
        return forcedimension.open_device(forcedimension.Options(**chosen), RATE_HZ)

    def displayed(self) -> tuple[float, ...]:
        x, y, z = self.stub.force()
        return y, -x, z

    def make(self, case: str) -> None:
        self.forbidden = case == "permission"
        knobs = {"busy": {"held": 1}, "lost": {"unplugged": 1}, "timeout": {"error": 7, "fail_read": 0}}
        self.stub.update(**knobs.get(case, {"devices": 0}))

    def mend(self) -> None:
        self.stub.reset()
        self.forbidden = False


@pytest.fixture
def bench(stub: Stub) -> OmegaBench:
    return OmegaBench(stub)
