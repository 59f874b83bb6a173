"""The Falcon's driver on a stand-in for libusb that answers at once or exactly as late as it is told to.

What only the true libusb shows is in test_falcon_emulated.py.
"""

from __future__ import annotations

import pytest
from drd_stub import COMPILER
from driver_contract import DriverContract
from usb_stub import NO_COMPILER, FalconBench, UsbStub, stub, usb_library

__all__ = ["stub", "usb_library"]  # fixtures

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)


@pytest.fixture
def bench(stub: UsbStub) -> FalconBench:
    return FalconBench(stub)


class TestContract(DriverContract):
    """The contract, with a device that answers within the tick."""
