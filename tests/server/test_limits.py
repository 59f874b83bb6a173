"""Limits of the force that depend on speed, heat or position: closed forms, and all of them for random wrenches."""

import math
from math import inf

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.sources import list_shipped
from softfinger.drivers.base import DeviceInfo
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.record import AT, FREE, RECORD_SIZE, ROLLING
from softfinger.server.loop import guard as g
from softfinger.server.loop import hand_limits as lim
from softfinger.server.loop.output import INITIAL_OUTPUT, Instant, cool_limits, limit_wrench
from softfinger.server.loop.passivity import HandMotion
from softfinger.server.loop.tick import continue_memory, make_start_memory
from softfinger.server.loop.tuning import make_tuning, with_offsets
from softfinger.server.offline.simulate import simulate

pytestmark = pytest.mark.plain

T = 0.001
NONE = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
ARM = DeviceInfo("arm", 3, 3, 40.0, 2.0, 5000.0, 30.0, (-0.1,) * 3, (0.1,) * 3)
"""Device whose force a hand holds."""


def make_guard(force_max=12.0, ramp=0.0, slew=1e9, **limits):
    """Return a guard with the given limits; all remaining limits are off."""
    return g.Guard(force_max, 0.3, slew, slew, ramp, 1.0, limits=lim.UNLIMITED._replace(**limits))


def tick(guard, passed, force=NONE, moved=NONE, mode=FREE, at=NONE, torque=NONE):
    """Run one tick of a handle that has moved by `moved` to `at`."""
    before = tuple(a - m for a, m in zip(at, moved, strict=True))
    motion = HandMotion(Pose(before, LEVEL), Pose(at, LEVEL), None)
    return limit_wrench(guard, passed, motion, float(mode), force, torque, Instant(0, T, T))


def exceed_speed(guard):
    """Return the state after 0.1 s with 3 m/s, faster than the limit of these tests."""
    passed = INITIAL_OUTPUT
    for _ in range(100):
        passed, bits = tick(guard, passed, (5.0, 0.0, 0.0), (3.0 * T, 0.0, 0.0))
    assert bits & g.TOO_FAST
    return passed


@pytest.mark.parametrize("speed", [2.1, 3.0, 5.0])
def test_the_filter_removes_the_force_of_a_handle_that_is_too_fast(speed):
    """A speed v is filtered to v (1 - r^n), r = tau / (tau + T); the force is zero from the first n above the limit."""
    guard, passed, forces = make_guard(speed=2.0, slow_s=0.5), INITIAL_OUTPUT, []
    for _ in range(100):
        passed, bits = tick(guard, passed, (5.0, 0.0, 0.0), (0.0, speed * T, 0.0))
        forces.append(passed.guard_state.force[0])
        assert bool(bits & g.TOO_FAST) == (passed.guard_state == g.INITIAL_GUARD_STATE)
    ratio = lim.SPEED_TIME_CONSTANT_S / (lim.SPEED_TIME_CONSTANT_S + T)
    first = math.floor(math.log(1.0 - 2.0 / speed) / math.log(ratio)) + 1
    assert forces == [5.0] * (first - 1) + [0.0] * (100 - first + 1)


def test_one_displaced_pose_is_not_too_fast():
    """The largest step that is not a jump, once or back and forth, gives at most d / (tau + T) = 0.91 m/s."""
    guard, passed = make_guard(speed=2.0, slow_s=0.5), INITIAL_OUTPUT
    step = 10.0 * T
    for moved in (step, 0.0, -step, step, 0.0):
        passed, bits = tick(guard, passed, (5.0, 0.0, 0.0), (moved, 0.0, 0.0))
        assert bits == 0 and passed.guard_state.force[0] == 5.0
        assert math.hypot(*passed.limit_state.velocity) <= step / (lim.SPEED_TIME_CONSTANT_S + T) * (1 + 1e-12)


def test_the_force_comes_back_once_the_handle_is_slow_for_a_time():
    guard = make_guard(speed=2.0, slow_s=lim.SLOW_TIME_S, ramp=0.5)
    passed, still = exceed_speed(guard), 0
    for n in range(2000):
        passed, bits = tick(guard, passed, (5.0, 0.0, 0.0), (1.5 * T if n == 300 else 0.0, 0.0, 0.0))
        slow = math.hypot(*passed.limit_state.velocity) <= 1.0
        still = still + 1 if slow else 0
        if not bits & g.TOO_FAST:
            break
    # 500 subtractions of 1 ms may leave a rounding for one more tick.
    assert still in (500, 501)
    assert passed.guard_state.force[0] == pytest.approx(5.0 * T / 0.5)


def test_with_arming_by_hand_only_a_disarmed_and_slow_tick_ends_it():
    guard = make_guard(speed=2.0, slow_s=inf)
    off = guard._replace(armed=0.0)
    passed, bits = tick(off, exceed_speed(guard), (5.0, 0.0, 0.0), (3.0 * T, 0.0, 0.0))
    assert bits == g.TOO_FAST | g.DISARMED
    for _ in range(2000):
        passed, bits = tick(guard, passed, (5.0, 0.0, 0.0))
        assert bits == g.TOO_FAST and passed.guard_state == g.INITIAL_GUARD_STATE
    passed, bits = tick(off, passed, (5.0, 0.0, 0.0))
    assert bits == g.DISARMED
    passed, bits = tick(guard, passed, (5.0, 0.0, 0.0))
    assert bits == 0 and passed.guard_state.force[0] == 5.0


@pytest.mark.parametrize("slow_s", [lim.SLOW_TIME_S, inf])
def test_a_tick_without_a_pose_ends_no_wait(slow_s):
    guard = make_guard(speed=2.0, slow_s=slow_s)
    passed = exceed_speed(guard)
    blind = cool_limits(guard, passed.limit_state, T)
    assert blind.wait == passed.limit_state.wait == slow_s and blind.velocity == NONE
    _, bits = tick(guard, passed._replace(limit_state=blind), (5.0, 0.0, 0.0))
    assert bits == g.TOO_FAST


def test_heat_follows_a_first_order_model():
    """Under F the heat is (F / F_c)^2 (1 - r^n), r = tau / (tau + T); without force or pose it falls by r."""
    guard, passed = make_guard(continuous=4.0, heat_s=2.0), INITIAL_OUTPUT
    ratio = 2.0 / (2.0 + T)
    for n in range(1, 1001):
        passed, bits = tick(guard, passed, (3.0, 0.0, 0.0))
        # A thousand steps, each rounded.
        assert bits == 0 and passed.limit_state.heat == pytest.approx(0.5625 * (1.0 - ratio**n), rel=1e-11)
    hot = passed.limit_state.heat
    cooled = cool_limits(guard, passed.limit_state, T).heat
    passed, _ = tick(guard, passed)
    assert cooled == passed.limit_state.heat == pytest.approx(hot * ratio, rel=1e-15)


def test_the_force_of_a_hot_motor_falls_to_the_continuous_force():
    """Under twice the continuous force, the force is unchanged until the heat is WARM, after -tau ln(1 - WARM / 4).
    Then dh/dt = (F^2 / F_c^2 - h) / tau, with F^2 falling by 3 / (1 - WARM) per unit of heat: 1 - h falls with the rate
    (1 + 3 / (1 - WARM)) / tau, and the force changes no faster than that."""
    guard, passed, heats, forces = make_guard(force_max=8.0, continuous=4.0, heat_s=2.0), INITIAL_OUTPUT, [], []
    for _ in range(4000):
        passed, bits = tick(guard, passed, (0.0, 8.0, 0.0))
        heats.append(passed.limit_state.heat)
        forces.append(passed.guard_state.force[1])
    first = next(n for n, force in enumerate(forces) if force < 8.0)
    whole_s = -2.0 * math.log(1.0 - lim.WARM_SHARE / 4.0)
    assert first * T == pytest.approx(whole_s, abs=2 * T)  # a tick of delay, and discrete steps
    rate = (1.0 + 3.0 / (1.0 - lim.WARM_SHARE)) / 2.0
    expected = (1.0 - heats[first - 1]) * np.exp(-rate * T * np.arange(1, 300))
    # Discrete steps have a first-order error, rate T / 2 = 0.4 % over a time of 1 / rate.
    np.testing.assert_allclose(1.0 - np.array(heats[first : first + 299]), expected, rtol=0.03)
    assert bits & g.MOTOR_HOT and max(heats) <= 1.0
    assert forces[-1] == pytest.approx(4.0, rel=1e-9) and min(forces) >= 4.0
    assert max(-np.diff(forces)) < 8.0 * rate * T  # smoothly: below a hundredth of the slew limit


def test_heat_does_not_limit_a_strong_motor():
    assert lim.compute_heat_limit(lim.UNLIMITED._replace(continuous=8.0), 1.5, 8.0) == 8.0
    assert lim.compute_heat_limit(lim.UNLIMITED, 1.5, 8.0) == 8.0


def test_speeds_at_the_limits_are_allowed():
    limits = lim.UNLIMITED._replace(speed=2.0, slow_s=0.5)
    assert lim.compute_remaining_wait(limits, 0.0, 2.0, True, T) == 0.0
    assert lim.compute_remaining_wait(limits, 0.25, 1.0, True, T) == 0.25 - T


def test_a_tick_of_zero_length_keeps_the_velocity():
    assert lim.smooth_velocity((0.1, 0.2, 0.3), (0.001, 0.0, 0.0), 0.0) == (0.1, 0.2, 0.3)


BOX = lim.Workspace((0.01, 0.0, 0.0), (0.05, 0.04, 0.03), 0.0, 500.0, 4.0)
BALL = lim.Workspace((0.01, 0.0, 0.0), NONE, 0.07, 500.0, 4.0)


@pytest.mark.parametrize(
    ("wall", "at", "force"),
    [
        (BALL, (0.01, 0.07, 0.0), NONE),
        (BALL, (0.01, 0.072, 0.0), (0.0, -1.0, 0.0)),
        (BALL, (0.01, 0.0, -0.2), (0.0, 0.0, 4.0)),
        (BOX, (0.06, -0.04, 0.03), NONE),
        (BOX, (0.063, 0.0, 0.0), (-1.5, 0.0, 0.0)),
        (BOX, (0.063, -0.044, 0.0), (-1.5, 2.0, 0.0)),
        (BOX, (0.01, 0.3, 0.0), (0.0, -4.0, 0.0)),
        (lim.NO_WALL, (9.0, 9.0, 9.0), NONE),
    ],
)
def test_the_soft_wall_pushes_back_by_the_depth_behind_it(wall, at, force):
    pushed, out = lim.compute_wall_force(wall, at)
    np.testing.assert_allclose(pushed, force, atol=1e-13)  # roundings of centimetres, times 500 N/m
    assert out == any(force)
    passed, bits = tick(make_guard(workspace=wall), INITIAL_OUTPUT, at=at)
    np.testing.assert_allclose(passed.guard_state.force, force, atol=1e-13)
    assert bits == (g.WORKSPACE_EDGE if out else 0)


def test_the_wall_force_is_limited_by_the_guard():
    wall = BALL._replace(stiffness=2000.0, force_max=40.0)
    passed, bits = tick(make_guard(workspace=wall, slew=2000.0), INITIAL_OUTPUT, (0.0, -40.0, 0.0), at=(0.01, 0.2, 0.0))
    assert passed.guard_state.force == pytest.approx((0.0, -2.0, 0.0))
    assert bits == g.WORKSPACE_EDGE | g.FORCE_CLAMPED | g.SLEW_LIMITED


any_force = st.tuples(*[st.one_of(st.floats(-50, 50), st.floats(allow_nan=True, allow_infinity=True))] * 3)
any_way = st.tuples(*[st.floats(-0.01, 0.01)] * 3)


@given(st.lists(st.tuples(any_force, any_force, any_way, st.sampled_from([FREE, ROLLING])), min_size=1, max_size=80))
@pytest.mark.scaled
@examples(60, 3000)
def test_no_limit_is_exceeded(steps):
    wall = BALL._replace(force_max=40.0)
    guard = make_guard(speed=2.0, slow_s=0.01, continuous=3.0, heat_s=0.02, energy=0.01, workspace=wall, slew=2000.0)
    passed, at = INITIAL_OUTPUT, NONE
    for force, torque, moved, mode in steps:
        before, at = passed, tuple(a + m for a, m in zip(at, moved, strict=True))
        passed, bits = tick(guard, passed, force, moved, mode, at, torque)
        size = math.hypot(*passed.guard_state.force)
        assert all(map(math.isfinite, (*passed.guard_state.force, *passed.guard_state.torque)))
        allowed = lim.compute_heat_limit(guard.limits, before.limit_state.heat, 12.0)
        if (earlier := math.hypot(*before.guard_state.force)) > allowed:  # 2 N along the tangent to that ball
            allowed = math.sqrt(earlier**2 - 4.0 * math.sqrt(earlier**2 - allowed**2) + 4.0)
        assert size <= min(12.0, allowed) * (1 + 1e-9)
        assert (size == 0.0) or not bits & g.TOO_FAST
        assert bool(bits & g.TOO_FAST) == (passed.limit_state.wait > 0.0)
        if before.limit_state.wait == 0.0 and math.hypot(*passed.limit_state.velocity) <= 2.0:
            assert not bits & g.TOO_FAST
        # Those ticks of the slew limit heat as well: at most six, from 12 N, each (12 / 3)^2 of 1 in 21.
        assert passed.limit_state.heat <= 1.0 + 6 * 16.0 / 21.0
        # As for the heat: six ticks of 12 N along the largest motion of this test in a tick.
        assert passed.limit_state.energy_given <= 0.02 + 7 * 12.0 * 0.01 * math.sqrt(3.0)


@pytest.mark.parametrize("workspace", [{}, {"radius_m": 0.07, "size_m": [0.1, 0.1, 0.1]}])
def test_a_workspace_is_a_sphere_or_a_box(workspace):
    with pytest.raises(ConfigError, match="radius_m"):
        build(schema.Rig, {"device": {"driver": "x"}, "guard": {"workspace": workspace}}, "rig.toml")


def test_the_workspace_moves_with_the_offset_of_its_device():
    rig = schema.Guard(workspace=schema.Workspace(radius_m=0.07, center_m=(0.0, 0.0, 0.01)))
    tuning = make_tuning(load_scene("paper-plane"), rig, [ARM])
    moved = with_offsets(tuning, ((0.5, 0.0, -0.25),))
    assert moved.guards[0].limits.workspace.center == (0.5, 0.0, -0.24)
    assert with_offsets(moved, tuning.offsets).guards[0].limits.workspace.center == pytest.approx((0.0, 0.0, 0.01))


def test_a_scene_that_is_replaced_does_not_cool_the_motors():
    tuning = make_tuning(load_scene("pinch"), schema.Guard(), [ARM, ARM])
    row = np.zeros(2 * RECORD_SIZE)
    second = row[RECORD_SIZE:]
    second[AT.limits_heat], second[AT.limits_energy], second[AT.servo_guard] = 0.9, 0.2, g.TOO_FAST | g.RAMPING
    first_state, second_state = continue_memory(make_start_memory(tuning.scene), tuning.guards, row).fingers
    assert first_state.limit_state == lim.INITIAL_LIMITS
    assert second_state.limit_state == lim.LimitState(NONE, lim.SLOW_TIME_S, 0.9, 0.0, 0.2, 0.0)


RECORDED = {
    "pinch": ("pinch-thumb", "pinch-index"),
    "lift-a-box": ("lift-thumb", "lift-index"),
    "squeeze-a-ball": ("squeeze-thumb", "squeeze-index"),
}
"""Recordings for scenes of several fingers."""
ALONE = ("press-roll-spin-drag", "roll-follow", "tap")
"""Recordings for one finger, except intentions of a simulated hand, which are deep in the objects open loop."""
SCENES = {name: load_scene(name) for name in list_shipped(schema.Scene)}
SIMPLE = [name for name, scene in SCENES.items() if len(scene.fingers) == 1 and scene.world is None]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", [*RECORDED, *SIMPLE])
def test_no_shipped_scene_reaches_a_limit_with_its_recordings(name):
    scene = SCENES[name]
    for recordings in [RECORDED[name]] if name in RECORDED else [(recording,) for recording in ALONE]:
        poses = [resample(load_poses(recording), 1000.0) for recording in recordings]
        count = min(map(len, poses))
        tuning = make_tuning(scene, load_rig("omega-6").guard, [ARM] * len(recordings))
        records = simulate(tuning, np.stack([recording[:count] for recording in poses], axis=1), 1000.0)
        bits = records[:, :, AT.servo_guard].astype(int)
        assert not (bits & (g.TOO_FAST | g.ENERGY_SPENT | g.MOTOR_HOT)).any(), recordings
