"""The tick at the extremes of its inputs, and the check of its results."""

import math

import numpy as np
import pytest

from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.cli import main
from softfinger.server.loop.guard import NOT_FINITE, POSE_REFUSED, guard_wrench
from softfinger.tools.stability import extremes, runs, wrenches

pytestmark = pytest.mark.plain
CASES = list(extremes.iter_cases())


@pytest.fixture(autouse=True)
def _numbers_of_any_size():
    """Kernels do not warn of overflows, and refuse their results; numpy, as plain Python, would warn."""
    with np.errstate(all="ignore"):
        yield


@pytest.mark.sampled(14)
@pytest.mark.parametrize("case", CASES, ids=[f"{case.name}: {case.given}" for case in CASES])
def test_extreme_ends_in_a_bounded_force_and_a_defined_state(case):
    finding = extremes.judge(case, extremes.run_case(case))
    assert finding.wrong == "" and finding.ticks == len(case.samples) > 0


@pytest.mark.scaled
def test_garbage_breaks_no_rule(cases):
    for row in runs.try_hostile(cases(400, 60_000)):
        assert row["broken"] == 0
        # A quarter of the samples have at least one corrupted number, with 1 - (7/8)^7 = 61 %; half of these numbers
        # are invalid.
        assert 0.05 < row["refused"] / row["ticks"] < 0.25
        # It grows from zero after each pose that is refused: how far depends on the longest stretch without one.
        assert row["force_max_n"] > cases(5, 9) / 10.0 * extremes.FORCE_MAX_N


def sound_records():
    records = np.zeros((3, RECORD_SIZE))
    records[:, AT.force] = extremes.FORCE_MAX_N
    return records


PERIOD = 0.001


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (AT.force, 1.001 * extremes.FORCE_MAX_N),
        (AT.force, np.nan),
        (AT.torque, -np.inf),
        (AT.torque, 1.001 * extremes.TORQUE_MAX_NM),
        (AT.contact_mode, 3.0),
        (AT.contact_mode, np.nan),
        (AT.proxy_position, np.nan),
        (AT.servo_guard, NOT_FINITE | 4),
        (AT.force, extremes.FORCE_MAX_N - 2.001),  # 2 N a tick
        (AT.torque, 0.051),
    ],
)
def test_judge_detects_every_broken_rule(at, value):
    records = sound_records()
    assert extremes.count_violations(records, PERIOD) == 0
    records[-1, at] = value
    assert extremes.count_violations(records, PERIOD) == 1


def test_judge_detects_wrongly_accepted_and_refused_poses():
    good = next(case for case in CASES if not case.refused)
    records = sound_records()
    assert extremes.judge(good._replace(expects=lambda _: ""), records).wrong == ""
    records[0, AT.servo_guard] = POSE_REFUSED
    assert extremes.judge(good, records).wrong == "a pose refused"
    assert extremes.judge(good._replace(refused=True), sound_records()).wrong == "a broken pose taken"


@pytest.mark.parametrize("wrenches_of", [case.given for case in wrenches.iter_cases()])
def test_the_guard_limits_arbitrary_wrenches(wrenches_of):
    (wrong,) = [wrong for wrenches_tried, _, _, _, wrong in wrenches.try_wrenches() if wrenches_tried == wrenches_of]
    assert wrong == ""


plain_guard = getattr(guard_wrench, "py_func", guard_wrench)


def unchecked(guard, guarded, force, torque, dt, period):
    force = tuple(0.0 if math.isnan(x) else x for x in force)
    torque = tuple(0.0 if math.isnan(x) else x for x in torque)
    return plain_guard(guard, guarded, force, torque, dt, period)


def without_slew(guard, guarded, *rest):
    return plain_guard(guard._replace(force_slew=1e9, torque_slew=1e9), guarded, *rest)


def without_ramp(guard, guarded, *rest):
    return plain_guard(guard._replace(ramp=0.0), guarded, *rest)


def with_late_slew(guard, guarded, force, torque, dt, period):
    return plain_guard(guard, guarded, force, torque, dt, max(dt, period))


def with_force_ramp_alone(guard, guarded, force, torque, dt, period):
    whole = plain_guard(guard._replace(ramp=0.0), guarded, force, torque, dt, period)[0]
    after, bits = plain_guard(guard, guarded, force, torque, dt, period)
    return after._replace(torque=whole.torque), bits


@pytest.mark.parametrize("broken", [unchecked, without_slew, without_ramp, with_late_slew, with_force_ramp_alone])
def test_a_guard_that_lost_a_part_does_not_pass(broken, monkeypatch):
    monkeypatch.setattr(wrenches, "guard_many", getattr(wrenches.guard_many, "py_func", wrenches.guard_many))
    monkeypatch.setattr(wrenches, "guard_wrench", plain_guard)
    assert all(wrong == "" for *_, wrong in wrenches.try_wrenches())
    monkeypatch.setattr(wrenches, "guard_wrench", broken)
    assert any(wrong for *_, wrong in wrenches.try_wrenches())
    failing = [extremes.ExtremeResult("wrench", "", 1, 0.0, "-", "", wrong) for *_, wrong in wrenches.try_wrenches()]
    monkeypatch.setattr(extremes, "try_extremes", lambda: failing)
    monkeypatch.setattr(runs, "try_hostile", lambda *_: [])
    assert main(["stability", "--extremes"]) == 1
