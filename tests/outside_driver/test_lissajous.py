"""The driver contract over this package's driver; `pytest test_lissajous.py`, with it and softfinger installed."""

import pytest

from softfinger.drivers import registry
from softfinger.server.driver_contract import FAULTS, RATE_HZ, REFUSALS, Bench, DriverContract


class Computed(Bench):
    """What stands behind this driver is arithmetic: nothing keeps it from opening, and nothing can fail."""

    cannot = dict.fromkeys([*REFUSALS, *FAULTS], "it is computed from its options")

    def open(self):
        driver = registry.load("lissajous")
        self.device = driver.open_device(driver.Options(), RATE_HZ)
        return self.device

    def displayed(self):
        return self.device.felt


@pytest.fixture
def bench():
    return Computed()


class TestLissajous(DriverContract):
    """Every test of the contract."""
