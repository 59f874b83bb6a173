"""Guard: its output is finite and bounded in norm and change, for any input."""

import math

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.server.loop import guard as g

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
def test_what_is_not_finite_becomes_zero_and_ramps_anew(bad, axis):
    wrench = [1.0] * 6
    wrench[axis] = bad
    after, bits = limit(LIMITS, ENGAGED, tuple(wrench[:3]), tuple(wrench[3:]), DT)
    assert (after, bits) == (g.INITIAL_GUARD_STATE, g.NOT_FINITE)


def test_clamp_keeps_the_direction():
    after, bits = limit(OPEN, ENGAGED, (30.0, 0.0, 40.0), (0.0, 0.0, 3.0), DT)
    assert bits == g.FORCE_CLAMPED | g.TORQUE_CLAMPED
    np.testing.assert_allclose(after.force, (7.2, 0.0, 9.6), rtol=1e-14)  # 12 N along (3, 0, 4) / 5
    np.testing.assert_allclose(after.torque, (0.0, 0.0, 0.3), rtol=1e-14)


def test_clamp_goes_by_the_norm():
    after, bits = limit(OPEN, ENGAGED, (8.0, -8.0, 8.0), (0.0, 0.0, 0.0), DT)
    assert bits == g.FORCE_CLAMPED
    np.testing.assert_allclose(after.force, np.array([1.0, -1.0, 1.0]) * 12.0 / math.sqrt(3.0), rtol=1e-14)


@pytest.mark.parametrize("excess", [1e-9, 1e-3])
def test_a_force_just_above_the_limit_is_clamped(excess):
    after, bits = limit(OPEN, ENGAGED, (0.0, 7.2 * (1.0 + excess), 9.6 * (1.0 + excess)), (0.0, 0.0, 0.0), DT)
    assert bits == g.FORCE_CLAMPED
    np.testing.assert_allclose(after.force, (0.0, 7.2, 9.6), rtol=1e-14)


def test_clamp_survives_forces_whose_square_overflows():
    after, _ = limit(OPEN, ENGAGED, (1e300, 1e300, 0.0), (0.0, 0.0, 0.0), DT)
    np.testing.assert_allclose(after.force, (12 / math.sqrt(2), 12 / math.sqrt(2), 0.0), rtol=1e-14)


@pytest.mark.parametrize("tiny", [1e-301, 5e-324])
def test_a_wrench_too_small_to_normalize_is_clamped_to_zero(tiny):
    none = OPEN._replace(force_max=0.0, torque_max=0.0)
    after, bits = limit(none, ENGAGED, (tiny, 0.0, 0.0), (0.0, -tiny, 0.0), DT)
    assert (after.force, after.torque) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert bits == g.FORCE_CLAMPED | g.TORQUE_CLAMPED
    after, bits = limit(OPEN, ENGAGED, (tiny, 0.0, 0.0), (0.0, -tiny, 0.0), DT)
    assert (after.force, after.torque, bits) == ((tiny, 0.0, 0.0), (0.0, -tiny, 0.0), 0)


def test_the_smallest_wrench_with_a_direction_is_clamped_along_it():
    small = OPEN._replace(force_max=1e-301)
    after, bits = limit(small, ENGAGED, (0.0, 1e-300, 0.0), (0.0, 0.0, 0.0), DT)
    assert bits == g.FORCE_CLAMPED and after.force[1] == pytest.approx(1e-301, rel=1e-14, abs=0.0)


def test_the_torque_alone_may_be_slew_limited():
    after, bits = limit(LIMITS, ENGAGED, (0.0, 0.0, 0.0), (0.0, 0.18, 0.24), DT)
    assert bits == g.SLEW_LIMITED
    np.testing.assert_allclose(after.torque, (0.0, 0.03, 0.04), rtol=1e-14)  # 0.05 N m along (0, 3, 4) / 5


def test_without_a_ramp_the_force_is_complete_at_once():
    after, bits = limit(OPEN, g.INITIAL_GUARD_STATE, (11.0, 0.0, 0.0), (0.0, 0.0, 0.25), DT)
    assert (after, bits) == (g.GuardState((11.0, 0.0, 0.0), (0.0, 0.0, 0.25), 1.0), 0)
    after, bits = limit(OPEN, g.INITIAL_GUARD_STATE, (13.0, 0.0, 0.0), (0.0, 0.0, 0.0), DT)
    assert bits == g.FORCE_CLAMPED and after.force[0] == pytest.approx(12.0, rel=1e-14)


def test_slew_limits_each_tick_along_the_way():
    after, bits = limit(LIMITS, ENGAGED, (6.0, 0.0, 8.0), (0.0, 0.0, 0.0), DT)
    assert bits == g.SLEW_LIMITED
    np.testing.assert_allclose(after.force, (1.2, 0.0, 1.6), rtol=1e-14)  # 2 N along (3, 0, 4) / 5


@pytest.mark.parametrize("period", [0.01, 0.001, 0.000125])
def test_slew_limit_is_a_speed(period):
    after, bits = limit(
        LIMITS._replace(force_max=1e3, torque_max=1e3), ENGAGED, (1e3, 0, 0), (0, 1e3, 0), period, period
    )
    assert bits & g.SLEW_LIMITED
    assert after.force[0] == pytest.approx(LIMITS.force_slew * period, rel=1e-12)  # rounding of a norm
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


def test_force_within_all_limits_passes_unchanged():
    force, torque = (0.1, -0.2, 0.3), (0.001, 0.002, -0.003)
    after, bits = limit(LIMITS, ENGAGED, force, torque, DT)
    assert (after.force, after.torque, bits) == (force, torque, 0)


def test_ramp_grows_linearly_from_engaging():
    before, forces = g.INITIAL_GUARD_STATE, []
    for _ in range(600):
        before, _ = limit(LIMITS, before, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), DT)
        forces.append(before.force[0])
    # 500 additions of 0.002 round to within 1e-12 of the exact share.
    np.testing.assert_allclose(forces[:500], np.arange(1, 501) / 500.0, atol=1e-12)
    assert forces[501:] == [1.0] * 99


def test_the_limits_do_not_grow_once_the_ramp_is_over():
    before = ENGAGED
    for _ in range(600):
        before, _ = limit(LIMITS, before, (20.0, 0.0, 0.0), (0.0, 0.4, 0.0), DT)
        assert before.gain == 1.0
    assert before.force[0] == pytest.approx(12.0, rel=1e-14) and before.torque[1] == pytest.approx(0.3, rel=1e-14)


def test_the_moment_ramps_with_the_force():
    before = g.INITIAL_GUARD_STATE
    for n in range(1, 500):
        before, bits = limit(LIMITS, before, (1.0, 0.0, 0.0), (0.0, 0.0, 0.1), DT)
        assert bits == g.RAMPING
        # Up to 500 additions of 0.002.
        assert (before.force[0], before.torque[2]) == pytest.approx((n / 500.0, 0.1 * n / 500.0), abs=1e-12)


@pytest.mark.parametrize("newtons", [6.0, 100.0, 400.0, 2e4, 1e300])
def test_the_ramp_has_the_same_length_on_a_stiff_wall(newtons):
    before, free = g.INITIAL_GUARD_STATE, LIMITS._replace(force_slew=1e9, torque_slew=1e9)
    whole = min(newtons / free.force_max, 1.0)
    for n in range(1, 501):
        before, bits = limit(free, before, (0.6 * newtons, 0.0, 0.8 * newtons), (0.0, newtons, 0.0), DT)
        # Up to 500 additions of 0.002.
        assert norm(before.force) / free.force_max == pytest.approx(whole * n / 500.0, abs=1e-12)
        assert norm(before.torque) / free.torque_max == pytest.approx(n / 500.0, abs=1e-12)
        assert bool(bits & g.FORCE_CLAMPED) == (whole == 1.0)


def test_disarmed_commands_zero():
    off = LIMITS._replace(armed=0.0)
    after, bits = limit(off, ENGAGED, (1.0, 0.0, 0.0), (0.0, 0.0, 0.1), DT)
    assert (after, bits) == (g.INITIAL_GUARD_STATE, g.DISARMED)


def test_every_bit_has_a_name():
    bits = (
        g.POSE_REFUSED,
        g.NOT_FINITE,
        g.RAMPING,
        g.FORCE_CLAMPED,
        g.TORQUE_CLAMPED,
        g.SLEW_LIMITED,
        g.DISARMED,
        g.POSE_JUMPED,
        g.POSE_FROZEN,
        g.TOO_FAST,
        g.MOTOR_HOT,
        g.ENERGY_SPENT,
        g.WORKSPACE_EDGE,
    )
    assert bits == tuple(1 << n for n in range(len(g.GUARD_NAMES)))


def test_plain_python_agrees_with_the_compiled_guard():
    rng = np.random.default_rng(3)
    before = g.INITIAL_GUARD_STATE
    for _ in range(200):
        force, torque = tuple(rng.normal(0, 10, 3).tolist()), tuple(rng.normal(0, 0.3, 3).tolist())
        after, bits = limit(LIMITS, before, force, torque, DT)
        assert g.guard_wrench.py_func(LIMITS, before, force, torque, DT, DT) == (after, bits)
        before = after
