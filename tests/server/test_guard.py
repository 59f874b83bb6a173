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


def test_without_a_ramp_the_force_is_complete_at_once():
    after, bits = limit(OPEN, g.INITIAL_GUARD_STATE, (11.0, 0.0, 0.0), (0.0, 0.0, 0.25), DT)
    assert (after, bits) == (g.GuardState((11.0, 0.0, 0.0), (0.0, 0.0, 0.25), 1.0), 0)
    after, bits = limit(OPEN, g.INITIAL_GUARD_STATE, (13.0, 0.0, 0.0), NONE, DT)
    assert bits == g.FORCE_CLAMPED and after.force[0] == pytest.approx(12.0, rel=1e-14)


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
