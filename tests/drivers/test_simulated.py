"""Simulated device behind its C functions: motion under force, stop, determinism, options; led by a program."""

from math import cos, pi, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_rig
from softfinger.config.schema import Rig
from softfinger.config.sources import list_shipped
from softfinger.drivers.base import END, OK, WITHHELD
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.drivers.simulated.device import Options, SimulatedDevice, open_device
from softfinger.drivers.simulated.hand import SPEED_MAX_M_PER_S, TURN_MAX_RAD_PER_S, RequestedPose, hold, lead_hand
from softfinger.drivers.simulated.options import load_presets
from softfinger.drivers.simulated.plant import compute_goal
from softfinger.proxy.kernels.numerics.tool import make_tool
from softfinger.server.driver_contract import DeviceCaller

AT = [0.0, 0.0, 0.02]
LOOSE = {"hand": {"mass_kg": 0.0, "damping_ns_per_m": 0.0, "stiffness_n_per_m": 0.0}}
BARE = {"damping_ns_per_m": [0, 0, 0], "friction_n": [0, 0, 0], "lag_s": 0, "delay_ticks": 0, "resolution_m": 0}
"""Only a mass."""


def opened(rate_hz: float = 1000.0, **options: Any) -> SimulatedDevice:
    return open_device(build(Options, options, "[device]"), rate_hz)


def test_a_force_moves_the_handle_until_stop() -> None:
    with opened(position_m=AT, mass_kg=[0.5, 0.5, 0.5], **LOOSE, **BARE) as device:
        servo, x = DeviceCaller(device), []
        for n in range(100):
            status, sample = servo.read()
            assert status == OK and sample[7] == pytest.approx(n * 0.001, abs=1e-15) and sample[3:7] == [1, 0, 0, 0]
            x.append(sample[0])
            assert servo.write(1.0, 0, 0, 0, 0, 0) == OK
        np.testing.assert_allclose(x, (np.arange(100) * 0.001) ** 2, rtol=1e-12, atol=1e-18)  # 100 additions
        device.stop()
        assert servo.write(1.0, 0, 0, 0, 0, 0) == WITHHELD
        flown = np.diff([servo.read()[1][0] for _ in range(50)])
    # The stop precedes the tick of the last write: the speed is that of 99 ticks.
    np.testing.assert_allclose(flown, 0.099 * 2.0 * 0.001, rtol=1e-9)  # a step of 2e-4 m as a difference of 2e-2 m
    assert device.read_log().wrench[-1].tolist() == [0.0] * 6


def test_free_hand_follows_its_recording() -> None:
    wanted = resample(load_poses("tap"), 1000.0)
    hand = {"mass_kg": 0.0, "damping_ns_per_m": 200.0, "stiffness_n_per_m": 1e5}
    with opened(recording="tap", loop=False, hand=hand, **BARE) as device:
        servo = DeviceCaller(device)
        reads = [servo.read() for _ in range(len(wanted))]
        assert [status for status, _ in reads] == [OK] * len(wanted) and servo.read() == (END, reads[-1][1])
    samples = np.array([sample for _, sample in reads])
    # Spring and damper cause an error of m a / k: 0.3 kg, 3 m/s^2 (a tap of 10 mm within 0.08 s has 9) over 1e5 N/m.
    assert np.abs(samples[:, :3] - wanted[:, :3]).max() < 1e-4
    assert samples[:, 3:7].tobytes() == np.ascontiguousarray(wanted[:, 3:]).tobytes()


@pytest.mark.parametrize("goal", [{"position_m": AT}, {"puck": {}}])
def test_only_a_hand_that_follows_a_recording_stops_after_one_pass(goal: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="loop = false: only a hand that follows a recording"):
        build(Options, {"loop": False, **goal}, "[device]")


@pytest.mark.parametrize("preset", ["omega.3", "falcon"])
def test_devices_without_a_wrist_sense_no_rotation(preset: str) -> None:
    with opened(preset=preset) as device:
        servo = DeviceCaller(device)
        assert {tuple(servo.read()[1][3:7]) for _ in range(4000)} == {(1.0, 0.0, 0.0, 0.0)}
        assert device.info.sensed_dof == device.info.actuated_dof == 3


def test_sway_is_a_sinusoid_about_the_position() -> None:
    device = opened(position_m=AT, sway_m=[0.001, 0.0, 0.002], sway_hz=7.3, sway_phase_rad=0.4)
    simulation = device.simulation
    for n in (0, 1, 500, 10**6):
        position, _ = compute_goal(simulation.intention, simulation.poses, n)
        wave = np.sin((2.0 * np.pi * 7.3 * n / 1000.0 + 0.4) % (2.0 * np.pi))
        # 7300 turns are known to 1e-12 of a turn.
        np.testing.assert_allclose(position, np.array(AT) + wave * np.array([0.001, 0.0, 0.002]), atol=1e-14)
    device.close()


def test_two_runs_are_equal_to_the_bit_and_saved_on_close(tmp_path: Path) -> None:
    runs = []
    for _ in range(2):
        with opened(preset="falcon", forces=str(tmp_path / "forces.npz")) as device:
            servo, samples = DeviceCaller(device), []
            for _ in range(3000):
                sample = servo.read()[1]
                samples.append(sample)
                servo.write(*(40.0 * (0.015 - x) for x in sample[:3]), 0.0, 0.0, 0.0)
        wrenches = device.read_log().wrench
        runs.append((np.array(samples).tobytes(), wrenches.tobytes()))
        with np.load(tmp_path / "forces.npz") as saved:
            assert saved["force"].tobytes() == wrenches[:, :3].tobytes() and len(wrenches) == 3001
    assert runs[0] == runs[1]


def test_shipped_rigs_open_their_device() -> None:
    devices = {name: load_rig(name).device for name in list_shipped(Rig)}
    single = {name: device for name, device in devices.items() if device is not None}
    names = [n for n, device in single.items() if device.driver == "simulated" and "puck" not in device.options]
    assert {single[n].options.get("preset", "omega.6") for n in names} == set(load_presets())
    for name in names:
        rig = load_rig(name)
        with open_device(build(Options, rig.device.options, name), rig.servo.rate_hz) as device:
            assert rig.guard.force_max_n == device.info.force_max_n
            assert rig.device.options["preset"] in device.info.name.lower()


FIRM = {"hand": {"mass_kg": 0.0, "damping_ns_per_m": 200.0, "stiffness_n_per_m": 1e5}, **BARE}
"""A hand that follows its goal to within 3 kg m/s^2 / 1e5 N/m."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
RATE_HZ = 1000.0


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
