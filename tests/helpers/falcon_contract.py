"""Driver contract for a Falcon, and its own behaviour; started by test_falcon_emulated.py, not directly."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np
import pytest

from helpers.remote_bench import RemoteBench
from helpers.waits import until
from softfinger.config.load import build, load_rig
from softfinger.drivers.base import OK, STALE, WITHHELD
from softfinger.drivers.falcon.device import Falcon, Options, open_device
from softfinger.server.driver_contract import RATE_HZ, Bench, DriverContract, Servo


class Emulated(RemoteBench):
    """Bench with the emulated device of the testbed, through libusb."""

    # Half a motor count at each leg is 4 mN at the knob, and the knob moves by 0.1 mm before the reading.
    force_step_n: ClassVar[float] = 0.01

    def open(self) -> Falcon:
        # A tick of the emulation waits for two other programs: it has longer silences than a bus.
        options = {**load_rig("falcon").device.options, "kick_s": 0.15, "timeout_s": 1.0}
        device = open_device(build(Options, options, "falcon [device]"), RATE_HZ)
        device.arm()
        return device


@pytest.fixture
def bench() -> Bench:
    return Emulated()


class TestContract(DriverContract):
    """The contract with the emulated device."""


def test_position_is_where_the_knob_is(bench: Emulated) -> None:
    with bench.open() as device:
        servo = Servo(device)
        while device.counts()["replies"] < 30:  # on a slow bus, a few milliseconds of the knob take many ticks
            assert servo.read()[0] in (OK, STALE, WITHHELD)
            servo.write(0.6, -0.4, 0.5, 0.0, 0.0, 0.0)
        time.sleep(0.05)  # after a pause the driver sends a zero to request a current reply
        status, sample = servo.read()
        assert status == WITHHELD
        # half a count is 0.3 mrad at a leg; a leg moves the knob by at most 1/15 m per radian; there are three legs
        np.testing.assert_allclose(sample[:3], bench.ask("place"), atol=3 * 0.5 * 6.4e-4 / 15)
        assert np.linalg.norm(np.array(sample[:3]) - (0.0, 0.0, 0.02)) > 1e-3, "the force did not move it"


def test_a_force_past_the_motors_is_limited(bench: Emulated) -> None:
    with bench.open() as device:
        servo = Servo(device)
        servo.read()
        assert servo.write(30.0, 0.0, 40.0, 0.0, 0.0, 0.0) == STALE
        x, y, z = bench.displayed()
        assert 5.0 < np.linalg.norm((x, y, z)) < 50.0
        np.testing.assert_allclose((x / z, y / z), (0.75, 0.0), atol=0.01)  # the knob moves before the reading
        assert device.counts()["cut"] == 1
        servo.read()
        assert servo.write(float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
        assert not any(bench.displayed())


def test_late_replies_cost_ticks(bench: Emulated) -> None:
    with bench.open() as device:
        servo = Servo(device)
        servo.read()
        bench.make("late")
        statuses, written = [], device.counts()["written"]
        before, begun = servo.read()[1], time.monotonic()
        for _ in range(10):
            servo.write(0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
            status, sample = servo.read()
            if status == STALE and OK not in statuses:
                assert sample == before
                assert device.counts()["written"] - written <= 2 * (1 + (time.monotonic() - begun) // 0.005)
            statuses.append(status)
        assert set(statuses) <= {OK, STALE, WITHHELD}  # WITHHELD after a pause of this machine
        assert STALE in statuses
        until(lambda: servo.read()[0] in (OK, WITHHELD), message="the late reply was lost")
