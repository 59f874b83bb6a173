"""Driver contract over this package's driver: run `pytest test_lissajous.py` with it and softfinger installed."""

import pytest

from softfinger.drivers import registry
from softfinger.server.driver_contract import FAULTS, RATE_HZ, REFUSALS, Bench, DriverContract


class Computed(Bench):
    """Bench of a computed device: opening and exchange cannot fail."""

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
    """The contract over the Lissajous figure."""
