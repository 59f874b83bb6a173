"""The driver contract over a Falcon. Run beside the emulated device by test_falcon_emulated.py, not by itself."""

from __future__ import annotations

import json
import os
import socket
import time
from typing import Any, ClassVar

import pytest
from driver_contract import RATE_HZ, Bench, DriverContract

from softfinger.config.load import build, load_rig
from softfinger.drivers.base import Device
from softfinger.drivers.falcon import Options, open_device


class Emulated(Bench):
    """The device of the testbed beside this program, through libusb."""

    # Half a motor count at each leg is 4 mN at the knob, and the knob moves by 0.1 mm before it is asked.
    resolution_n: ClassVar[float] = 0.01

    def ask(self, line: str) -> Any:
        with socket.socket(socket.AF_UNIX) as end:
            end.connect(os.environ["FALCON_TESTBED"])
            end.sendall(line.encode() + b"\n")
            with end.makefile() as stream:
                return json.loads(stream.readline())

    def open(self) -> Device:
        # A tick of the emulation waits for two other programs: silences are longer than on a bus.
        given = {**load_rig("falcon").device.options, "kick_s": 0.15, "timeout_s": 0.2}
        return open_device(build(Options, given, "falcon [device]"), RATE_HZ)

    def displayed(self) -> tuple[float, ...]:
        x, y, z = self.ask("displayed")
        return (x, y, z)

    def make(self, case: str) -> None:
        self.ask(f"make {case}")
        if case == "timeout":
            time.sleep(0.05)  # after a pause the next read waits for a reply of now

    def mend(self) -> None:
        self.ask("mend")


@pytest.fixture
def bench() -> Bench:
    return Emulated()


class TestContract(DriverContract):
    """The contract over the emulated device."""
