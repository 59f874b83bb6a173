"""Driver contract over a HID arm of the guest; run by on_hid.py."""

from typing import ClassVar

import pytest
from helpers.hid_devices import rig_options
from helpers.remote_bench import RemoteBench

from softfinger.drivers.hid.device import HidDevice, open_device
from softfinger.server import driver_contract
from softfinger.server.driver_contract import RATE_HZ


class Bench(RemoteBench):
    """Bench on the gadget's arm through its node."""

    # An encoder count and 1 mA of a motor are 8 mN at the end, and the arm moves before it is queried.
    force_step_n: ClassVar[float] = 0.03

    def open(self) -> HidDevice:
        return open_device(rig_options("woodenhaptics-2019", kick_s=0.1, timeout_s=1.0), RATE_HZ)


@pytest.fixture
def bench() -> Bench:
    return Bench()


class TestContract(driver_contract.DriverContract):
    """The contract over the node."""
