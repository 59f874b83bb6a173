"""The tick at the ends of its inputs, and the judge that decides whether it held."""

import numpy as np
import pytest

from softfinger.proxy.state import OFFSET, RECORD_SIZE
from softfinger.server.guard import NOT_FINITE, POSE_REFUSED
from softfinger.tools.stability import extremes

CASES = list(extremes.cases())


@pytest.mark.parametrize("case", CASES, ids=[f"{case.name}: {case.given}" for case in CASES])
def test_extreme_ends_in_a_bounded_force_and_a_defined_state(case):
    """Force finite and bounded, a mode of the three, what was refused named, and what the case expects beside."""
    finding = extremes.judge(case, extremes.run_case(case))
    assert finding.wrong == ""
    assert finding.ticks == len(case.samples) > 0


def test_garbage_never_leaves_the_rules():
    """Random NaN, infinities, subnormal, huge and zero numbers and time jumps: no tick breaks a rule."""
    for row in extremes.try_hostile(60_000):
        assert row["broken"] == 0
        # A quarter of the samples holds at least one spoilt number with 1 - (7/8)^7 = 61 %, half of them bad ones.
        assert 0.05 < row["refused"] / row["ticks"] < 0.25
        assert row["force_max_n"] > 0.9 * extremes.FORCE_MAX_N


def sound_records():
    records = np.zeros((3, RECORD_SIZE))
    records[:, OFFSET["force"]] = extremes.FORCE_MAX_N
    return records


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("force", 1.001 * extremes.FORCE_MAX_N),
        ("force", np.nan),
        ("torque", -np.inf),
        ("torque", 1.001 * extremes.TORQUE_MAX_NM),
        ("contact.mode", 3.0),
        ("contact.mode", np.nan),
        ("proxy.position", np.nan),
        ("servo.guard", NOT_FINITE | 4),
    ],
)
def test_judge_sees_every_broken_rule(name, value):
    """One tick with one broken rule is counted; without it none is."""
    records = sound_records()
    assert extremes.broken_rules(records) == 0
    records[1, OFFSET[name]] = value
    assert extremes.broken_rules(records) == 1


def test_judge_knows_what_was_to_be_refused():
    """A broken pose that is taken, and a good one that is refused, are both wrong."""
    good = next(case for case in CASES if not case.refused)
    records = sound_records()
    assert extremes.judge(good._replace(expects=lambda _: ""), records).wrong == ""
    records[0, OFFSET["servo.guard"]] = POSE_REFUSED
    assert extremes.judge(good, records).wrong == "a pose refused"
    assert extremes.judge(good._replace(refused=True), sound_records()).wrong == "a broken pose taken"
