"""The driver contract over a HID arm of the guest. Run by on_hid.py, not by itself."""

from __future__ import annotations

import json
import os
import socket
from typing import Any, ClassVar

import driver_contract
import pytest
from driver_contract import RATE_HZ
from hid_devices import rig_options

from softfinger.drivers.hid import HidDevice, open_device


class Bench(driver_contract.Bench):
    """The arm of the gadget beside this process, through its node."""

    # An encoder count and 1 mA of a motor are 8 mN at the end, and the arm moves before it is asked.
    force_step_n: ClassVar[float] = 0.03
    patience_s: ClassVar[float] = 10.0

    def ask(self, line: str) -> Any:
        with socket.socket(socket.AF_UNIX) as end:
            end.connect(os.environ["FALCON_TESTBED"])
            end.sendall(line.encode() + b"\n")
            with end.makefile() as stream:
                return json.loads(stream.readline())

    def open(self) -> HidDevice:
        return open_device(rig_options("woodenhaptics-2019", kick_s=0.1, timeout_s=1.0), RATE_HZ)

    def displayed(self) -> tuple[float, ...]:
        x, y, z = self.ask("displayed")
        return (x, y, z)

    def make(self, case: str) -> None:
        self.ask(f"make {case}")

    def mend(self) -> None:
        self.ask("mend")


@pytest.fixture
def bench() -> Bench:
    return Bench()


class TestContract(driver_contract.DriverContract):
    """The contract over the node."""
