"""Statistics of a study: confidence, model comparison, population means, exclusions, survey scores."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats
from test_trial_order import make_tables

from softfinger.server.experiment.analysis import ALL_PARTICIPANTS, find_excluded_participants, fit_groups
from softfinger.server.experiment.comparison import (
    compare_levels,
    compare_models,
    compute_chi_squared_tail,
    compute_level_differences,
    estimate_population,
)
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.psychometric import compute_probability
from softfinger.server.experiment.surveys import compare_scores, survey_table

pytestmark = pytest.mark.plain

STUDY = "stiffness-and-workload"
PARTICIPANTS = range(1, 7)
TLX = {"name": "load", "at": ["after"], "file": "nasa-tlx"}
CATCH = {"rate": 0.5, "level": 1.0, "min_right": 0.75}


@pytest.fixture(scope="module")
def study() -> tuple[Experiment, list[dict[str, Any]]]:
    experiment = Experiment(STUDY)
    rows = [
        row | row["levels"] | {"participant": f"sub-{number:02d}"}
        for number in PARTICIPANTS
        for row in experiment.rehearse(number)
    ]
    return experiment, rows


def test_confidence_follows_signal_detection() -> None:
    """The share of each mark is that of |x| in its interval, x normal with mean Phi^-1(p) and unit variance."""
    experiment = Experiment(
        make_tables(confidence={}, factor=[]),
        {"procedure.levels": [0.15], "procedure.repetitions": 2000, "observer.lapse": 0.0},
    )
    rows, observer = experiment.rehearse(), experiment.file.observer
    mean = stats.norm.ppf(float(compute_probability(0.15, observer.threshold, observer.slope)))
    edges = np.array([0.0, 0.5, 1.0, 1.5, np.inf])
    right = np.diff(stats.norm.cdf(edges - mean))
    wrong = np.diff(stats.norm.cdf(edges + mean))
    for is_right, shares in ((True, right), (False, wrong)):
        marks = Counter(row["confidence"] for row in rows if row["right"] == is_right)
        # 4.5 standard deviations of a share of 2000 trials
        assert [marks[mark] / 2000 for mark in (1.0, 2.0, 3.0, 4.0)] == pytest.approx(shares, abs=4.5 * 0.5 / 2000**0.5)


def test_the_likelihood_ratio_is_that_of_scipys_maxima(study: tuple[Experiment, list[dict[str, Any]]]) -> None:
    experiment, rows = study
    total = 0.0
    two = [row for row in rows if row["participant"] in ("sub-01", "sub-02")]
    for participant in ("sub-01", "sub-02"):
        own = [row for row in two if row["participant"] == participant and not row["practice"] and not row["catch"]]
        level, right = np.array([row["level"] for row in own]), np.array([row["right"] for row in own])
        damped = np.array([row["condition"] == "4.0" for row in own])

        def loss(point: Any, at: Any = (level, right, damped)) -> float:
            threshold = np.exp(np.where(at[2], point[-2], point[0]))
            chance = compute_probability(at[0], threshold, np.exp(point[-1]), lapse=0.02)
            return -float(np.log(np.where(at[1], chance, 1.0 - chance)).sum())

        slopes = np.log([0.5, 12.0])
        best = [
            optimize.differential_evolution(loss, [(-5.0, 2.0)] * count + [slopes], rng=1, tol=1e-8).fun
            for count in (1, 2)
        ]
        total += 2.0 * (best[0] - best[1])
    (comparison,) = compare_models(experiment.file, two)
    # Half a grid step, 1 % of a threshold and 4 % of a slope, costs some hundredths at each of the 4 maxima.
    assert comparison.chi_squared == pytest.approx(total, abs=0.1) and comparison.freedom == 2
    assert comparison.p_value == pytest.approx(stats.chi2.sf(comparison.chi_squared, 2)) and comparison.p_value < 0.001
    assert comparison.aic_difference == pytest.approx(comparison.chi_squared - 4.0)


def test_numbers_are_compared_by_regression() -> None:
    """With an intercept per condition chi squared is n log(RSS0 / RSS1), checked by NumPy's least squares."""
    task = {"kind": "rate", "parameter": "object.table.material.stiffness_n_per_m", "question": "?"}
    experiment = Experiment(
        make_tables(task=task, procedure={"kind": "constant", "levels": [100.0, 300.0, 900.0], "repetitions": 6}),
        {"observer.by": {"2.0": {"scale": 15.0}}},
    )
    rows = [row | row["levels"] | {"participant": "sub-01"} for row in experiment.rehearse()]
    x, y = np.log([row["level"] for row in rows]), np.log([row["answer"] for row in rows])
    dummies = np.array([[row["damping"] == level for level in (0.0, 1.0, 2.0)] for row in rows], float)
    with_factor = np.linalg.lstsq(np.column_stack([dummies, x]), y, rcond=None)[1][0]
    without = np.linalg.lstsq(np.column_stack([np.ones_like(x), x]), y, rcond=None)[1][0]
    (comparison,) = compare_models(experiment.file, rows)
    assert comparison.chi_squared == pytest.approx(len(y) * np.log(without / with_factor)) and comparison.freedom == 2


def test_chi_squared_is_scipys() -> None:
    for freedom in (1, 2, 3, 4, 5, 8, 31):
        for value in (0.0, 0.1, 1.0, 4.0, 30.0, 200.0):
            assert compute_chi_squared_tail(value, freedom) == pytest.approx(stats.chi2.sf(value, freedom), rel=1e-9)


def test_means_over_participants_are_geometric(study: tuple[Experiment, list[dict[str, Any]]]) -> None:
    experiment, rows = study
    groups = fit_groups(experiment.file, rows)
    for population in estimate_population(groups):
        logs = np.log(
            [
                group.fit.threshold
                for group in groups
                if group.condition == population.condition and group.participant != ALL_PARTICIPANTS
            ]
        )
        assert population.mean == pytest.approx(np.exp(logs.mean()))
        assert population.interval_95 == pytest.approx(np.exp(stats.t.interval(0.95, 5, logs.mean(), stats.sem(logs))))


def test_ratios_are_within_participants(study: tuple[Experiment, list[dict[str, Any]]]) -> None:
    experiment, rows = study
    groups = fit_groups(experiment.file, rows)
    (ratio,) = compare_levels(experiment.file, groups, ["sub-06"])
    thresholds = {
        condition: [
            np.log(group.fit.threshold)
            for group in groups
            if group.condition == condition and group.participant not in (ALL_PARTICIPANTS, "sub-06")
        ]
        for condition in ("0.0", "4.0")
    }
    paired = stats.ttest_rel(thresholds["4.0"], thresholds["0.0"]).confidence_interval()
    assert ratio[:4] == ("damping", "4.0", "0.0", 5)
    assert ratio.interval_95 == pytest.approx((np.exp(paired.low), np.exp(paired.high)))
    assert ratio.interval_95[0] <= 2.0 <= ratio.interval_95[1]


def test_differences_of_two_factors_vary_one_factor_at_a_time() -> None:
    factors = [
        {"name": name, "parameter": f"object.table.material.{key}", "levels": levels}
        for name, key, levels in (("a", "damping_ns_per_m", [0.0, 1.0]), ("b", "friction.static", [0.5, 0.7, 0.9]))
    ]
    file, shift = Experiment(make_tables(factor=factors)).file, {0.5: 0.0, 0.7: 10.0, 0.9: 30.0}
    values = {
        (who, f"{a}, {b}"): extra + a + shift[b] * (1.0 + extra)
        for who, extra in (("sub-01", 0.0), ("sub-02", 0.1))
        for a in (0.0, 1.0)
        for b in (0.5, 0.7, 0.9)
    }
    differences = compute_level_differences(file, values | {("sub-03", "0.0, 0.5"): 7.0})
    assert [(row.factor, row.level, row.baseline, row.participants) for row in differences] == [
        ("a", "1.0", "0.0", 2), ("b", "0.7", "0.5", 2), ("b", "0.9", "0.5", 2)
    ]  # fmt: skip
    assert [row.value for row in differences] == pytest.approx([1.0, 10.5, 31.5])
    assert differences[1].interval_95 == pytest.approx(stats.t.interval(0.95, 1, 10.5, stats.sem([10.0, 11.0])))


def test_a_participant_who_fails_catch_trials_is_excluded() -> None:
    experiment = Experiment(make_tables(factor=[], catch=CATCH))
    guessing = Experiment(make_tables(factor=[], catch=CATCH), {"observer.threshold": 1e3})
    rows = [
        row | {"participant": f"sub-0{number}"}
        for number, variant in enumerate((experiment, experiment, guessing), 1)
        for row in variant.rehearse(number)
    ]
    assert list(find_excluded_participants(experiment.file, rows)) == ["sub-03"]
    pooled = [group for group in fit_groups(experiment.file, rows) if group.participant == ALL_PARTICIPANTS]
    assert [group.trials for group in pooled] == [24]


def test_a_score_is_the_mean_of_all_ratings() -> None:
    names = [question.name for question in Experiment(make_tables(survey=[TLX])).file.survey[0].question]
    file = Experiment(make_tables(survey=[TLX])).file
    row = {"participant": "sub-01", "survey": "load", "block": 1, "condition": None}
    answers = [row | {"question": name, "answer": 10.0 * k} for k, name in enumerate(names, 1)]
    table = survey_table(file, answers)
    assert [(entry["question"], entry["mean"]) for entry in table][-1] == ("mean", 35.0) and len(table) == 7
    assert len(survey_table(file, answers[:-1])) == 5


def test_scores_are_compared_within_participants() -> None:
    file = Experiment(make_tables(survey=[TLX | {"at": ["between", "after"]}]), {"design.order": "given"}).file
    answers = [
        {"participant": who, "survey": "load", "block": block, "condition": condition, "question": question.name,
         "answer": 30.0 + more}
        for who, rise in (("sub-01", 10.0), ("sub-02", 20.0))
        for block, condition, more in ((1, "0.0", 0.0), (2, "1.0", rise), (3, "2.0", 5.0))
        for question in file.survey[0].question
    ]  # fmt: skip
    (title, first), (_, second) = compare_scores(file, answers)
    paired = stats.ttest_rel([40.0, 50.0], [30.0, 30.0]).confidence_interval()
    assert title == "NASA-TLX" and first[:5] == ("damping", "1.0", "0.0", 2, 15.0)
    assert first.interval_95 == pytest.approx((paired.low, paired.high))
    assert second.value == 5.0 and compare_scores(file, answers[:6]) == []
