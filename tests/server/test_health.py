"""Health of the loop: conditions that end a run, and conditions that must not."""

import pytest

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.server.loop import health as h
from softfinger.server.loop.guard import NOT_FINITE, POSE_JUMPED, POSE_REFUSED, RAMPING
from softfinger.tools.pages.hazards import compute_stall_range_s, compute_starvation_time_s

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
