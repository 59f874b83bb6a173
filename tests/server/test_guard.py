"""Guard: output finite and bounded for any input, limits of rig and device; health of the loop: causes of its end."""

import dataclasses
import math
from pathlib import Path

import numba
import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from softfinger.config import schema
from softfinger.config.load import load_scene
from softfinger.drivers.base import DeviceInfo
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.model import State
from softfinger.server.loop import guard as g
from softfinger.server.loop import health as h
from softfinger.server.loop.guard import NOT_FINITE, POSE_JUMPED, POSE_REFUSED, RAMPING, Guard
from softfinger.server.loop.limits import SLOW_TIME_S, UNLIMITED, Limits, Workspace
from softfinger.server.loop.tick import begin
from softfinger.server.loop.tuning import guard_limits, make_tuning
from softfinger.tools.pages.hazards import compute_stall_range_s, compute_starvation_time_s

DT = 0.001
LIMITS = g.Guard(12.0, 0.3, 2000.0, 50.0, 0.5, 1.0)
ENGAGED = g.GuardState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
OPEN = g.Guard(12.0, 0.3, 1e9, 1e9, 0.0, 1.0)

any_vector = st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3)


@entry
def limit(guard, guarded, force, torque, dt, period=DT):
    return g.guard_wrench(guard, guarded, force, torque, dt, period)


def norm(v):
    return math.hypot(*v)


@given(st.lists(st.tuples(any_vector, any_vector), min_size=1, max_size=30))
@example([((0.0, 0.0, 0.0), (0.0, 0.0, 2.2e-313))])  # the inverse of a subnormal number overflows
@pytest.mark.scaled
@examples(150, 3000)
def test_output_is_always_finite_bounded_and_slow(wrenches):
    before = g.INITIAL_GUARD_STATE
    for force, torque in wrenches:
        after, bits = limit(LIMITS, before, force, torque, DT)
        assert all(map(math.isfinite, (*after.force, *after.torque)))
        # One part in 1e12: the scalings round a few times.
        assert norm(after.force) <= LIMITS.force_max * (1 + 1e-12)
        assert norm(after.torque) <= LIMITS.torque_max * (1 + 1e-12)
        if not bits & g.NOT_FINITE:  # a refused wrench becomes zero at once
            assert norm(np.subtract(after.force, before.force)) <= LIMITS.force_slew * DT * (1 + 1e-9)
            assert norm(np.subtract(after.torque, before.torque)) <= LIMITS.torque_slew * DT * (1 + 1e-9)
        before = after


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(6))
def test_a_force_that_is_not_finite_becomes_zero_and_ramps_up_again(bad, axis):
    wrench = [1.0] * 6
    wrench[axis] = bad
    after, bits = limit(LIMITS, ENGAGED, tuple(wrench[:3]), tuple(wrench[3:]), DT)
    assert (after, bits) == (g.INITIAL_GUARD_STATE, g.NOT_FINITE)


NONE = (0.0, 0.0, 0.0)
BOTH = g.FORCE_CLAMPED | g.TORQUE_CLAMPED
OFF = OPEN._replace(force_max=0.0, torque_max=0.0)


@pytest.mark.parametrize(
    ("guard", "wrench", "expected", "bits"),
    [
        (LIMITS, ((0.1, -0.2, 0.3), (0.001, 0.002, -0.003)), ((0.1, -0.2, 0.3), (0.001, 0.002, -0.003)), 0),
        (OPEN, ((30.0, 0.0, 40.0), (0.0, 0.0, 3.0)), ((7.2, 0.0, 9.6), (0.0, 0.0, 0.3)), BOTH),  # along (3, 0, 4) / 5
        (OPEN, ((8.0, -8.0, 8.0), NONE), ((48.0**0.5, -(48.0**0.5), 48.0**0.5), NONE), g.FORCE_CLAMPED),  # by the norm
        (OPEN, ((0.0, 7.2 * (1.0 + 1e-9), 9.6 * (1.0 + 1e-9)), NONE), ((0.0, 7.2, 9.6), NONE), g.FORCE_CLAMPED),
        (OPEN, ((0.0, 7.2 * (1.0 + 1e-3), 9.6 * (1.0 + 1e-3)), NONE), ((0.0, 7.2, 9.6), NONE), g.FORCE_CLAMPED),
        # the square overflows
        (OPEN, ((1e300, 1e300, 0.0), NONE), ((72.0**0.5, 72.0**0.5, 0.0), NONE), g.FORCE_CLAMPED),
        # too small to normalize
        (OFF, ((1e-301, 0.0, 0.0), (0.0, -1e-301, 0.0)), (NONE, NONE), BOTH),
        (OFF, ((5e-324, 0.0, 0.0), (0.0, -5e-324, 0.0)), (NONE, NONE), BOTH),
        (OPEN, ((1e-301, 0.0, 0.0), (0.0, -1e-301, 0.0)), ((1e-301, 0.0, 0.0), (0.0, -1e-301, 0.0)), 0),
        (OPEN, ((5e-324, 0.0, 0.0), (0.0, -5e-324, 0.0)), ((5e-324, 0.0, 0.0), (0.0, -5e-324, 0.0)), 0),
        # the smallest with a direction
        (OPEN._replace(force_max=1e-301), ((0.0, 1e-300, 0.0), NONE), ((0.0, 1e-301, 0.0), NONE), g.FORCE_CLAMPED),
        # 2 N along (3, 0, 4) / 5, and 0.05 N m along (0, 3, 4) / 5
        (LIMITS, ((6.0, 0.0, 8.0), NONE), ((1.2, 0.0, 1.6), NONE), g.SLEW_LIMITED),
        (LIMITS, (NONE, (0.0, 0.18, 0.24)), (NONE, (0.0, 0.03, 0.04)), g.SLEW_LIMITED),
        (LIMITS._replace(armed=0.0), ((1.0, 0.0, 0.0), (0.0, 0.0, 0.1)), (NONE, NONE), g.DISARMED),
    ],
)
def test_a_wrench_is_limited_along_its_direction(guard, wrench, expected, bits):
    after, limited = limit(guard, ENGAGED, *wrench, DT)
    assert limited == bits and after.gain == (0.0 if bits == g.DISARMED else 1.0)
    np.testing.assert_allclose((after.force, after.torque), expected, rtol=1e-14)
    assert bits or (after.force, after.torque) == expected


@pytest.mark.parametrize("period", [0.01, 0.001, 0.000125])
def test_slew_limit_is_a_speed(period):
    strong = LIMITS._replace(force_max=1e3, torque_max=1e3)
    after, bits = limit(strong, ENGAGED, (1e3, 0, 0), (0, 1e3, 0), period, period)
    assert bits & g.SLEW_LIMITED and after.force[0] == pytest.approx(LIMITS.force_slew * period, rel=1e-12)  # rounding
    assert after.torque[1] == pytest.approx(LIMITS.torque_slew * period, rel=1e-12)


@pytest.mark.parametrize("pause", [0.002, 0.005, 0.02, 0.1])
def test_a_pause_widens_neither_slew_nor_ramp(pause):
    force, torque = (10.0, 0.0, 0.0), (0.0, 0.2, 0.0)
    assert limit(LIMITS, ENGAGED, force, torque, pause) == limit(LIMITS, ENGAGED, force, torque, DT)
    ramping = g.GuardState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.2)
    assert limit(LIMITS, ramping, force, torque, pause)[0].gain == pytest.approx(0.2 + DT / LIMITS.ramp)


@pytest.mark.parametrize("pause", [0.1001, 1.0, math.inf, math.nan])
def test_a_long_pause_restarts_the_ramp(pause):
    """After a long pause the hand may have moved, so the force starts from zero as after engaging."""
    before = g.GuardState((5.0, 0.0, 0.0), (0.0, 0.1, 0.0), 1.0)
    force, torque = (5.0, 0.0, 0.0), (0.0, 0.1, 0.0)
    assert limit(LIMITS, before, force, torque, pause) == limit(LIMITS, g.INITIAL_GUARD_STATE, force, torque, DT)
    assert norm(limit(LIMITS, before, force, torque, pause)[0].force) <= 5.0 * DT / LIMITS.ramp


@pytest.mark.parametrize("newtons", [1.0, 6.0, 100.0, 400.0, 2e4, 1e300])
def test_the_ramp_has_the_same_length_on_a_stiff_wall(newtons):
    """Shares of the limits grow linearly, of force and torque together, until both are complete and then no further."""
    before, free = g.INITIAL_GUARD_STATE, LIMITS._replace(force_slew=1e9, torque_slew=1e9)
    whole_force, whole_torque = min(newtons / free.force_max, 1.0), min(0.1 * newtons / free.torque_max, 1.0)
    clamped = g.FORCE_CLAMPED * (whole_force == 1.0) | g.TORQUE_CLAMPED * (whole_torque == 1.0)
    for n in range(1, 601):
        before, bits = limit(free, before, (0.6 * newtons, 0.0, 0.8 * newtons), (0.0, 0.1 * newtons, 0.0), DT)
        # Up to 500 additions of 0.002.
        share = min(n / 500.0, 1.0)
        assert norm(before.force) / free.force_max == pytest.approx(whole_force * share, abs=1e-12)
        assert norm(before.torque) / free.torque_max == pytest.approx(whole_torque * share, abs=1e-12)
        assert n == 500 or bits == (clamped | g.RAMPING if n < 500 else clamped)
    assert before.gain == 1.0


def test_every_bit_has_a_name():
    assert [getattr(g, name.upper()) for name in g.GUARD_NAMES] == [1 << n for n in range(len(g.GUARD_NAMES))]


FAR = (1.0, 1.0, 1.0)
STRONG = DeviceInfo("strong", 6, 6, 100.0, 10.0, 1e4, 10.0, (-1.0, -1.0, -1.0), FAR)
RIG = schema.Guard(
    force_max_n=7.0, torque_max_nm=0.2, force_slew_n_per_s=1234.0, torque_slew_nm_per_s=56.0, ramp_s=0.25,
    speed_max_m_per_s=4.0, turn_max_rad_per_s=30.0, frozen_s=2.0,
    handle_speed_max_m_per_s=1.5, continuous_force_n=3.0, heat_time_s=20.0, energy_max_j=0.4,
    workspace=schema.Workspace(center_m=(0.1, 0.0, 0.0), radius_m=0.05, stiffness_n_per_m=300.0, force_max_n=4.0),
    arm="command",
)  # fmt: skip
WALL = Workspace((0.1, 0.0, 0.0), (0.0, 0.0, 0.0), 0.05, 300.0, 4.0)
HAND = Limits(1.5, math.inf, 3.0, 20.0, 0.4, WALL)
RIG_LIMITS = Guard(7.0, 0.2, 1234.0, 56.0, 0.25, 1.0, 4.0, 30.0, 2.0, limits=HAND)


def test_every_limit_of_the_rig_reaches_the_guard():
    assert guard_limits(RIG, STRONG) == RIG_LIMITS
    box = schema.Guard(continuous_force_n=3.0, workspace=schema.Workspace(size_m=(0.1, 0.08, 0.06)))
    wall = Workspace((0.0, 0.0, 0.0), (0.05, 0.04, 0.03), 0.0, 500.0, 4.0)
    assert guard_limits(box, STRONG).limits == Limits(2.0, SLOW_TIME_S, 3.0, 30.0, 0.2, wall)
    assert guard_limits(schema.Guard(arm="button"), STRONG).limits.slow_s == math.inf


def test_poses_are_checked_only_with_a_force_in_a_hand():
    believing = RIG_LIMITS._replace(speed_max=math.inf, turn_max=math.inf, frozen=0.0, limits=UNLIMITED)
    recorded, puck = dataclasses.replace(STRONG, own_clock=True), dataclasses.replace(STRONG, actuated_dof=0)
    assert guard_limits(RIG) == guard_limits(RIG, recorded) == believing
    assert guard_limits(RIG, puck)._replace(displays_torque=1.0) == believing


@pytest.mark.parametrize(("field", "limit"), [("force_max_n", "force_max"), ("torque_max_nm", "torque_max")])
def test_limits_are_lowered_to_those_of_the_device(field, limit, caplog):
    weak = dataclasses.replace(STRONG, **{field: 0.1})
    assert guard_limits(RIG, weak) == RIG_LIMITS._replace(**{limit: 0.1})
    assert make_tuning(load_scene("paper-plane"), RIG, [weak]).guards == (guard_limits(RIG, weak),)
    assert f"guard.{field}" in caplog.text and "0.1" in caplog.text


def test_devices_without_torque_are_known():
    for driven, turns in ((3, 0.0), (6, 1.0)):
        assert guard_limits(RIG, dataclasses.replace(STRONG, actuated_dof=driven)).displays_torque == turns
    assert guard_limits(RIG).displays_torque == 1.0


@pytest.mark.parametrize(("exponent", "stiffness"), [(1.0, 1000.0), (1.5, 1.5 * 12.0 ** (1 / 3) * 1000.0)])
def test_an_object_stiffer_than_the_device_gives_a_warning(exponent, stiffness, caplog):
    scene = load_scene("paper-plane", {"object.0.material.normal.exponent": exponent})
    for limit, has_warning in ((1.001 * stiffness, False), (0.999 * stiffness, True)):
        caplog.clear()
        make_tuning(scene, schema.Guard(force_max_n=12.0), [dataclasses.replace(STRONG, stiffness_max_n_per_m=limit)])
        assert (f"'table' has {stiffness:.0f} N/m at the guard's 12 N" in caplog.text) == has_warning


def test_a_geom_without_contacts_gives_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = tmp_path / "model.xml"
    model.write_text(
        '<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="2 1 1 1"/></asset><worldbody>'
        '<geom name="hills" type="hfield" hfield="h"/><geom name="own" type="hfield" hfield="h"/><geom size="1"/>'
        '<geom size="1" contype="0" conaffinity="0"/>'
        '<flexcomp name="cloth" type="grid" count="2 2 1" spacing="1 1 1" dim="2"/></worldbody></mujoco>'
    )
    material = {"stiffness_n_per_m": 500.0}
    own = {"name": "own", "shape": "plane", "material": material}
    world = {"model": str(model), "geom": [{"name": name, "material": material} for name in ("hills", "own")]}
    make_tuning(load_scene({"fingertip": {"radius_m": 0.01}, "world": world, "object": [own]}), RIG)
    hills, cloth = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert hills.startswith("fingers pass through geom 'hills': it is a height field with pixels of 2 m along x and")
    assert cloth == "fingers pass through geom 'cloth': it is a flexible body, which fingers cannot touch"


@pytest.mark.parametrize("name", ["paper-plane", "ball-in-a-bowl"])
def test_loop_and_engine_share_the_kernels_of_the_contact(name):
    engine, tuning = Engine(name), make_tuning(load_scene(name), RIG)
    memory = begin(tuning.scene)
    start = State(memory.world, tuple(finger.contact for finger in memory.fingers))
    assert numba.typeof((tuning.scene, start)) == numba.typeof((engine.scene, engine._begin))


T = 0.001


@entry
def examine_tick(health, bits, late, dt, period):
    return h.examine(health, bits, late, dt, period)


def examine_ticks(ticks, health=h.HEALTHY):
    """Return the health after ticks of (bits, late, dt), the first fault, and the ticks and time until then."""
    elapsed = 0.0
    for number, (bits, late, dt) in enumerate(ticks):
        health, fault = examine_tick(health, bits, late, dt, T)
        elapsed += dt
        if fault:
            return health, fault, number + 1, elapsed
    return health, 0, len(ticks), elapsed


GOOD, NO_POSE, NO_FORCE = (RAMPING, 0.0, T), (POSE_REFUSED | RAMPING, 0.0, T), (NOT_FINITE, 0.0, T)


@pytest.mark.parametrize(("tick", "fault"), [(NO_POSE, h.NO_POSE), (NO_FORCE, h.NO_FORCE)])
def test_half_a_second_without_a_force_is_a_fault(tick, fault):
    _, first_fault, count, _ = examine_ticks([tick] * 2000)
    assert (first_fault, abs(count - h.NO_FORCE_MAX_S / T) <= 2) == (fault, True)  # 500 additions; above the limit


def test_frequent_bad_poses_are_a_fault_and_occasional_ones_are_not():
    assert examine_ticks([NO_POSE, NO_POSE, GOOD] * 2000)[1] == h.NO_POSE
    assert examine_ticks([NO_POSE, GOOD] * 5000)[1] == 0
    assert examine_ticks(([NO_POSE] * 400 + [GOOD] * 600) * 20)[1] == 0


def test_jumps_that_leave_nothing_to_render_are_a_fault():
    jump = (POSE_JUMPED, 0.0, T)
    assert examine_ticks([jump] * 5)[1:3] == (h.JUMPING, 5)
    assert examine_ticks(([jump] * 4 + [GOOD] * 1000) * 5)[1] == 0
    for a_second, fault in ((10, h.JUMPING), (9, 0)):
        assert examine_ticks(([jump] + [GOOD] * (1000 // a_second - 1)) * 60 * a_second)[1] == fault


def test_gaps_of_every_length_end_the_run_within_the_fault_model():
    shortest, longest = compute_stall_range_s()
    assert 1.0 < shortest < longest < 1.3
    for gap in (h.GAP_MIN_S, 0.0337, 0.0611, 0.0977, 0.1533, 0.1999, 0.24, h.GAP_MAX_S):
        _, fault, _, elapsed = examine_ticks([(0, 0.0, gap + T)] * 100)
        assert fault == h.STARVED
        assert elapsed == pytest.approx(compute_starvation_time_s(gap), rel=1e-9)  # sums of many periods
        assert shortest - T <= elapsed <= longest + T  # the range of `compute_stall_range_s`
    assert examine_ticks([(0, 0.0, h.GAP_MIN_S - 1e-6 + T)] * 1000)[1] == 0  # shorter ones are missed ticks


def test_short_stalls_and_one_long_sleep_are_no_fault():
    assert examine_ticks(([(0, 0.02, 0.021)] + [GOOD] * 180) * 300)[1] == 0
    health, fault, _, _ = examine_ticks([(0, 3600.0, 3600.0)] + [GOOD] * 1000)
    assert (fault, health) == (0, h.HEALTHY)


@pytest.mark.parametrize(("late", "woken"), [(0.24, True), (0.0, False)])
def test_the_cause_is_where_most_time_was_lost(late, woken):
    health, fault, _, _ = examine_ticks([(0, late, 0.241)] * 20)
    assert fault == h.STARVED
    assert (health.late > 0.5 * health.lost) == woken
