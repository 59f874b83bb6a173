"""Driver contract for a Falcon, and its own behaviour; started by test_falcon_emulated.py, not directly."""

import time
from typing import ClassVar

import numpy as np
import pytest

from helpers.remote_bench import RemoteBench
from helpers.rig_files import rig_options
from softfinger.drivers.base import OK, STALE, WITHHELD
from softfinger.drivers.falcon.device import Falcon, open_device
from softfinger.server.driver_contract import RATE_HZ, Bench, DeviceCaller, DriverContract


class Emulated(RemoteBench):
    """Bench with the emulated device of the testbed, through libusb."""

    # Half a motor count at each leg is 4 mN at the knob, and the knob moves by 0.1 mm before the reading.
    force_step_n: ClassVar[float] = 0.01

    def open(self) -> Falcon:
        # A tick of the emulation waits for two other programs: it has longer silences than a bus.
        device = open_device(rig_options("falcon", kick_s=0.15, timeout_s=1.0), RATE_HZ)
        device.arm()
        return device


@pytest.fixture
def bench() -> Bench:
    return Emulated()


class TestContract(DriverContract):
    """The contract with the emulated device."""


def test_position_is_where_the_knob_is(bench: Emulated) -> None:
    with bench.open() as device:
        servo = DeviceCaller(device)
        while device.counts()["replies"] < 30:  # on a slow bus, a few milliseconds of the knob take many ticks
            assert servo.read()[0] in (OK, STALE, WITHHELD)
            servo.write(0.6, -0.4, 0.5, 0.0, 0.0, 0.0)
        time.sleep(0.05)  # after a pause the driver sends a zero to request a current reply
        status, sample = servo.read()
        assert status == WITHHELD
        while device.counts()["replies"] < device.counts()["written"]:  # it waits for 0.1 s: a slow bus answers later
            _, sample = servo.read()
        # half a count is 0.3 mrad at a leg; a leg moves the knob by at most 1/15 m per radian; there are three legs
        np.testing.assert_allclose(sample[:3], bench.ask("place"), atol=3 * 0.5 * 6.4e-4 / 15)
        assert np.linalg.norm(np.array(sample[:3]) - (0.0, 0.0, 0.02)) > 1e-3, "the force did not move it"
