"""Packets of a Falcon whose replies stop or are late while it pulls, through the real loop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from helpers.c_stub import COMPILER
from helpers.usb_stub import NO_COMPILER, FalconBench, UsbStub, stub, usb_library
from helpers.waits import until

from softfinger.config.load import load_rig, load_scene
from softfinger.server.driver_contract import PULL, RATE_HZ
from softfinger.server.loop.servo_thread import Servo
from softfinger.server.loop.tuning import make_tuning

__all__ = ["stub", "usb_library"]  # fixtures

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]

PULL_N = 4.0
SLEW_N = 0.2
"""Slew limit of the guard per tick, small enough that several ticks in one step show."""
STEP_N = 2 * 0.01
"""Half a motor count at each leg is 4 mN at the knob, which moves a millisecond before the exchange; at both ends."""
RAMP_S = 0.2
LOGGED = 8192


def pull(stub: UsbStub) -> np.ndarray:
    """Return the upward force (N) of each packet since `logged` was 0, (n,)."""
    return stub.log()[:, 2]


@contextmanager
def running(stub: UsbStub, ramp_s: float, **knobs: float) -> Iterator[None]:
    scene = load_scene({**PULL, "effect": [{"kind": "constant_force", "force_n": [0.0, 0.0, PULL_N]}]})
    guard = load_rig("falcon", {"guard.ramp_s": ramp_s, "guard.force_slew_n_per_s": SLEW_N * RATE_HZ}).guard
    with FalconBench(stub).open(timeout_s=2.0, kick_s=0.02) as device:
        device.info = replace(device.info, own_clock=True)
        servo = Servo([device], make_tuning(scene, guard, [device.info]), RATE_HZ)
        servo.compile()
        stub.update(still=1, logged=0, **knobs)
        servo.start()
        try:
            yield
        finally:
            servo.stop()
            assert servo.join(60.0) is not None
            servo.close()
    assert stub["logged"] < LOGGED, "not every packet was seen"


def test_a_force_ramps_up_after_a_silence(stub: UsbStub) -> None:
    with running(stub, RAMP_S):
        until(lambda: stub["logged"] > 0 and pull(stub)[-1] > 0.99 * PULL_N)
        before = len(pull(stub)) - 1
        stub["mute_at"] = 0.0
        until(lambda: not pull(stub)[before:].all())
        time.sleep(0.06)
        stub["mute_at"] = -1.0
        until(lambda: pull(stub)[-1] > 0.99 * PULL_N)
        forces = pull(stub)
    zeros = np.flatnonzero(forces[before:] == 0.0) + before
    assert np.diff(forces).max() <= SLEW_N + STEP_N
    back = forces[zeros[-1] + 1 :]
    # A tick adds its share to the ramp; at most a few ticks lie between two packets.
    assert back[0] <= 4 * PULL_N / (RAMP_S * RATE_HZ) + STEP_N
    assert len(back) > RAMP_S * RATE_HZ / 4


@pytest.mark.parametrize("late", [2, 4])
def test_a_force_that_waits_is_no_wider_step(late: int, stub: UsbStub) -> None:
    with running(stub, 0.01, late=late):
        until(lambda: stub["logged"] > 0 and pull(stub)[-1] > 0.99 * PULL_N)
        forces = pull(stub)
    assert np.diff(forces).max() <= SLEW_N + STEP_N
    assert np.count_nonzero((forces > 0.0) & (forces < PULL_N - STEP_N)) >= PULL_N / SLEW_N / 2
