"""Simulated hand that a program leads: speed limits, range, return to its recording, errors."""

from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.drivers.simulated.device import Options, SimulatedDevice, open_device
from softfinger.drivers.simulated.hand import SPEED_MAX_M_PER_S, TURN_MAX_RAD_PER_S, RequestedPose, hold, lead_hand
from softfinger.proxy.kernels.numerics.tool import make_tool
from softfinger.server.driver_contract import DeviceCaller

AT = (0.0, 0.0, 0.02)
BARE = {"damping_ns_per_m": [0, 0, 0], "friction_n": [0, 0, 0], "lag_s": 0, "delay_ticks": 0, "resolution_m": 0}
FIRM = {"hand": {"mass_kg": 0.0, "damping_ns_per_m": 200.0, "stiffness_n_per_m": 1e5}, **BARE}
"""A hand that follows its goal to within 3 kg m/s^2 / 1e5 N/m."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
RATE_HZ = 1000.0


def opened(**options: Any) -> SimulatedDevice:
    return open_device(build(Options, options, "[device]"), RATE_HZ)


def read(servo: DeviceCaller, count: int) -> np.ndarray:
    """Return samples (count, 7) of `count` reads."""
    return np.array([servo.read()[1][:7] for _ in range(count)])


def test_a_led_hand_reaches_its_target_within_its_speed_limits() -> None:
    turned = (cos(pi / 4), 0.0, 0.0, sin(pi / 4))
    with opened(position_m=AT, **FIRM) as device:
        servo = DeviceCaller(device)
        read(servo, 10)
        device.hand().lead((0.04, 0.0, 0.02), turned)
        poses = read(servo, 1500)
    # averaged, because the spring oscillates
    speeds = np.linalg.norm(poses[50:, :3] - poses[:-50, :3], axis=1) * RATE_HZ / 50
    assert 0.9 * SPEED_MAX_M_PER_S < speeds.max() < 1.05 * SPEED_MAX_M_PER_S
    turns = 2.0 * np.arccos(np.clip(np.abs((poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1)), 0.0, 1.0)) * RATE_HZ
    assert turns.max() < TURN_MAX_RAD_PER_S * (1.0 + 1e-6)
    np.testing.assert_allclose(poses[-500:, :3], [[0.04, 0.0, 0.02]] * 500, atol=1e-8)  # 30 time constants
    np.testing.assert_allclose(poses[-1, 3:], turned, atol=1e-8)


def test_a_lead_without_an_orientation_preserves_it() -> None:
    with opened(position_m=AT, **FIRM) as device:
        servo = DeviceCaller(device)
        device.hand().lead(AT, (0.6, 0.8, 0.0, 0.0))
        before = read(servo, 1500)[-1]
        device.hand().lead((0.01, 0.0, 0.02))
        after = read(servo, 500)[-1]
    assert before[4] == pytest.approx(0.8, abs=1e-8)  # 40 time constants
    np.testing.assert_allclose(after[3:], before[3:], atol=1e-14)  # a normalisation per tick


def test_a_released_hand_resumes_its_recording() -> None:
    with opened(recording="tap", loop=True, **FIRM) as led, opened(recording="tap", loop=True, **FIRM) as alone:
        ours, theirs = DeviceCaller(led), DeviceCaller(alone)
        read(ours, 100), read(theirs, 100)
        led.hand().lead((0.03, 0.0, 0.03))
        assert np.abs(read(ours, 400) - read(theirs, 400)).max() > 0.02
        led.hand().release()
        read(ours, 2000), read(theirs, 2000)
        # The plant forgets its past within time constants of a millisecond.
        np.testing.assert_allclose(read(ours, 500), read(theirs, 500), atol=1e-12)


def test_a_recording_ends_also_if_the_hand_is_led() -> None:
    with opened(recording="tap", loop=False, **FIRM) as led, opened(recording="tap", loop=False, **FIRM) as alone:
        led.hand().lead(AT)
        ours, theirs = DeviceCaller(led), DeviceCaller(alone)
        statuses = [(ours.read()[0], theirs.read()[0]) for _ in range(2400)]
    assert all(a == b for a, b in statuses) and statuses[-1][0] != statuses[0][0]


def test_impossible_orientations_raise_errors() -> None:
    with opened(position_m=AT) as device, opened(position_m=AT, preset="omega.3") as wristless:
        with pytest.raises(ConfigError, match=r"omega\.3 measures no orientation: remove orientation_wxyz"):
            lead_hand(wristless, None, (0.0, 0.0, 0.0), RequestedPose(AT, UPRIGHT, UPRIGHT))
        with pytest.raises(ConfigError, match="all zero is not an orientation"):
            lead_hand(device, None, (0.0, 0.0, 0.0), RequestedPose(AT, (0.0, 0.0, 0.0, 0.0), UPRIGHT))


def test_a_lead_is_for_the_tip_of_the_tool() -> None:
    tool = make_tool((0.0, 0.0, -0.05), (0.0, 1.0, 0.0, 0.0))
    with opened(position_m=AT, **FIRM) as device:
        servo = DeviceCaller(device)
        lead_hand(device, tool, (0.01, 0.0, 0.0), RequestedPose((0.02, 0.0, -0.03), (0.0, 1.0, 0.0, 0.0), UPRIGHT))
        sample = read(servo, 2000)[-1]
    # The tip is rotated by half a turn about x relative to the handle, so the handle is upright, 50 mm above and 10 mm
    # aside.
    np.testing.assert_allclose(sample, [0.01, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0], atol=1e-7)


def test_hold_freezes_the_goal_of_the_hand() -> None:
    soft = {"hand": {"mass_kg": 0.1, "damping_ns_per_m": 20.0, "stiffness_n_per_m": 1000.0}, **BARE}
    tool = make_tool((0.0, 0.0, -0.05), (0.0, 1.0, 0.0, 0.0))
    with opened(recording="tap", loop=True, **soft) as device:
        servo = DeviceCaller(device)
        servo.write(0.0, 0.0, 2.0, 0.0, 0.0, 0.0)
        read(servo, 700)
        goal, tip = device.hand().intends()[0], hold(device, tool, (0.01, 0.0, 0.0))
        rested = read(servo, 1000)[-1]
        assert device.hand().intends()[0] == goal
        assert rested[:3] == pytest.approx(np.add(goal, (0.0, 0.0, 2.0 / 1000.0)), abs=1e-9)  # 100 time constants
        assert tip.position == pytest.approx(np.add(goal, (0.01, 0.0, -0.05)))
        lead_hand(device, tool, (0.01, 0.0, 0.0), RequestedPose(tip.position, tip.orientation, UPRIGHT))
        np.testing.assert_allclose(read(servo, 200)[:, :3], [rested[:3]] * 200, atol=1e-9)
