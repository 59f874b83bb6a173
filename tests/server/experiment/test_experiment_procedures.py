"""Staircases, QUEST+ and maximum likelihood fits against closed forms and SciPy; statistics of a study."""

import math
from collections import Counter, defaultdict
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import optimize, stats
from test_trial_order import make_tables

from softfinger.config.sources import EXPERIMENTS, list_names
from softfinger.server.experiment import analysis
from softfinger.server.experiment.comparison import (
    compare_levels,
    compare_models,
    compute_chi_squared_tail,
    compute_level_differences,
    estimate_population,
)
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.procedures import GRID_POINTS, QuestPlus, Staircase
from softfinger.server.experiment.psychometric import QUANTILES, SLOPE, SLOPE_SD, SLOPES, compute_probability, fit
from softfinger.server.experiment.schema_trials import Procedure
from softfinger.server.experiment.surveys import compare_scores, survey_table
from softfinger.server.experiment.trial_order import choose_by_condition

pytestmark = pytest.mark.plain

LEVELS = (0.05, 0.1, 0.2, 0.4)


def test_the_function_has_its_closed_form() -> None:
    """Chance at level 0, 1 - lapse at infinity, and 1 - 1/e of the interval between them at the threshold."""
    assert compute_probability(0.0, 0.2, 2.0, lapse=0.02) == 0.5
    assert compute_probability(1e6, 0.2, 2.0, lapse=0.02) == pytest.approx(0.98, abs=1e-15)
    assert compute_probability(0.2, 0.2, 2.0, lapse=0.02) == pytest.approx(0.5 + 0.48 * (1.0 - np.exp(-1.0)), abs=1e-15)


def test_a_staircase_converges_to_the_level_of_two_right_in_a_row() -> None:
    """The geometric mean of its levels converges to p^2 = 1/2 (Levitt 1971), within a step of 2 %."""
    stairs = Staircase(Procedure(kind="staircase", start=0.5, step=1.02, smallest=1e-3))
    rng, tried = np.random.default_rng(1), []
    for _ in range(20_000):
        tried.append(stairs.level())
        stairs.update(tried[-1], bool(rng.random() < compute_probability(tried[-1], 0.2, 2.0)))
    wanted = 0.2 * np.sqrt(-np.log(1.0 - (np.sqrt(0.5) - 0.5) / 0.5))
    # Small steps deviate by a few steps, and the mean of 20 000 trials by less than one.
    assert np.exp(np.mean(np.log(tried[1000:]))) == pytest.approx(wanted, rel=0.02)


def test_a_staircase_follows_its_rule() -> None:
    stairs = Staircase(Procedure(kind="staircase", start=0.4, step=2.0, smallest=0.1, largest=0.8))
    levels = []
    for right in (True, True, False, True, True, False, False, False):
        stairs.update(stairs.level(), right)
        levels.append(round(stairs.level(), 9))
    assert levels == [0.4, 0.1, 0.4, 0.4, 0.2, 0.4, 0.8, 0.8]


def test_quest_plus_chooses_the_level_of_least_expected_entropy() -> None:
    """The reference computes the expected entropy of four levels answer by answer on the same grid."""
    chosen = QuestPlus(LEVELS, 0.02)
    thresholds = np.geomspace(0.5 * LEVELS[0], 2.0 * LEVELS[-1], GRID_POINTS)
    pairs = [(threshold, slope) for threshold in thresholds for slope in SLOPES]
    weights = np.full(len(pairs), 1.0 / len(pairs))
    for right in (True, False, True):
        expected = []
        for level in LEVELS:
            hit = np.array([float(compute_probability(level, a, b, lapse=0.02)) for a, b in pairs])
            total = 0.0
            for outcome in (hit, 1.0 - hit):
                joint = weights * outcome
                total += joint.sum() * stats.entropy(joint / joint.sum())
            expected.append(total)
        best = LEVELS[int(np.argmin(expected))]
        assert chosen.level() == best
        hit = np.array([float(compute_probability(best, a, b, lapse=0.02)) for a, b in pairs])
        weights = weights * (hit if right else 1.0 - hit)
        weights /= weights.sum()
        chosen.update(best, right)


def test_the_fit_is_the_posterior() -> None:
    """Medians and 95 % intervals are quantiles of the posterior, integrated here by Gauss-Legendre quadrature."""
    rng = np.random.default_rng(3)
    levels = np.repeat([0.05, 0.1, 0.2, 0.4, 0.8], 40)
    right = rng.random(len(levels)) < compute_probability(levels, 0.2, 1.8, lapse=0.02)
    nodes, weights = np.polynomial.legendre.leggauss(120)

    def weight(thresholds: tuple[float, float], slopes: tuple[float, float]) -> float:
        (low, high), (flat, steep) = np.log(thresholds), np.log(slopes)
        a = low + (high - low) * (nodes + 1.0) / 2.0
        b = flat + (steep - flat) * (nodes + 1.0) / 2.0
        chance = compute_probability(levels, np.exp(a)[:, None, None], np.exp(b)[None, :, None], lapse=0.02)
        likelihood = np.exp(np.log(np.where(right, chance, 1.0 - chance)).sum(axis=-1) + 80.0)  # about e^-80
        prior = stats.norm.pdf(b, np.log(SLOPE), SLOPE_SD)
        return float((high - low) * (steep - flat) * (weights @ (likelihood * prior) @ weights))

    estimate, widest, all_slopes = fit(levels, right, 0.02), (0.02, 2.0), (SLOPES[0], SLOPES[-1])
    whole = weight(widest, all_slopes)
    for share, threshold, slope in zip(
        QUANTILES,
        (estimate.threshold_95[0], estimate.threshold, estimate.threshold_95[1]),
        (estimate.slope_95[0], estimate.slope, estimate.slope_95[1]),
        strict=True,
    ):
        # A grid step, 1.9 % of the threshold and 8 % of the slope, has some hundredths of the weight.
        assert weight((widest[0], threshold), all_slopes) / whole == pytest.approx(share, abs=0.01)
        assert weight(widest, (SLOPES[0], slope)) / whole == pytest.approx(share, abs=0.02)
    x, curve, below, above = estimate.curve.T
    assert (below <= curve).all() and (curve <= above).all() and len(x) == 60 and not estimate.bounded
    middle = compute_probability(x, estimate.threshold, estimate.slope, lapse=0.02)
    assert curve == pytest.approx(middle, abs=0.02)  # a median of functions is close to the function of the medians


def test_uniform_answers_leave_the_threshold_unbounded() -> None:
    for answers in (True, False):
        stairs = Staircase(Procedure(kind="staircase"))
        levels = []
        for _ in range(40):
            levels.append(stairs.level())
            stairs.update(levels[-1], answers)
        assert stairs.reversals == 0
        estimate = fit(levels, [answers] * 40, 0.02)
        assert estimate.bounded and "not bounded by the answers" in analysis.format_fit(estimate)
        assert (estimate.threshold < min(levels)) if answers else (estimate.threshold > max(levels))


def test_students_quantile_is_scipys() -> None:
    for freedom in (1, 2, 3, 4, 5, 10, 31, 200):
        assert analysis.compute_student_975(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), abs=1e-10)


def test_a_power_law_is_a_line_of_logarithms() -> None:
    rng = np.random.default_rng(4)
    levels = np.repeat([0.1, 0.3, 0.9], 5)
    answers = 10.0 * levels**0.8 * np.exp(0.2 * rng.standard_normal(15))
    line, estimate = stats.linregress(np.log(levels), np.log(answers)), analysis.fit_power_law(levels, answers)
    half = line.stderr * stats.t.ppf(0.975, 13)
    assert estimate.exponent == pytest.approx(line.slope) and estimate.scale == pytest.approx(np.exp(line.intercept))
    assert estimate.exponent_95 == pytest.approx((line.slope - half, line.slope + half))
    # At the mean level, the line's interval is that of a mean with two fitted numbers.
    middle = np.log(answers).mean()
    around = np.sqrt(((np.log(answers) - line.intercept - line.slope * np.log(levels)) ** 2).sum() / 13 / 15)
    around *= stats.t.ppf(0.975, 13)
    assert estimate.middle == pytest.approx(0.3) and estimate.answer == pytest.approx(np.exp(middle))
    assert estimate.answer_95 == pytest.approx(np.exp([middle - around, middle + around]))


def test_a_single_level_has_no_exponent() -> None:
    answers = np.array([9.0, 11.0, 14.0])
    estimate = analysis.fit_power_law([0.5] * 3, answers)
    mean = stats.t.interval(0.95, 2, np.log(answers).mean(), stats.sem(np.log(answers)))
    assert np.isnan(estimate.exponent) and estimate.answer_95 == pytest.approx(np.exp(mean))
    assert (
        analysis.format_fit(estimate)
        == f"answer 11.1 ({estimate.answer_95[0]:.3g} to {estimate.answer_95[1]:.3g}) at 0.5"
    )
    assert analysis.format_fit(analysis.fit_power_law([0.5], [9.0])) == "answer 9 at 0.5"


def recover(name: str, seeds: int) -> dict[str, tuple[float, float]]:
    """For each condition: mean error over the seeds (of thresholds, of their logarithm), and share of intervals of 95 %
    that contain the observer's value."""
    errors = defaultdict[str, list[tuple[float, bool]]](list)
    experiment = Experiment(name)
    for seed in range(seeds):
        design = msgspec.structs.replace(experiment.file.design, seed=seed)
        experiment.file = msgspec.structs.replace(experiment.file, design=design)  # its scenes are read once
        rows = [row | {"participant": "sub-01"} for row in experiment.rehearse()]
        for group in analysis.fit_groups(experiment.file, rows):
            condition = next(candidate for candidate in experiment.conditions if candidate.name == group.condition)
            observer = choose_by_condition(experiment.file.observer, condition)
            if isinstance(group.fit, analysis.PowerLaw):
                truth, interval = observer.exponent, group.fit.exponent_95
                error = group.fit.exponent / truth - 1.0
            else:
                truth, interval = observer.threshold, group.fit.threshold_95
                error = math.log(group.fit.threshold / truth)
            errors[group.condition].append((error, interval[0] <= truth <= interval[1]))
    return {name: tuple(np.mean(rows, axis=0)) for name, rows in errors.items()}


def test_a_power_law_is_recovered() -> None:
    """Over 5 seeds the mean exponent misses by less than a tenth: 4 times its standard error of 2 %."""
    ((bias, _),) = recover("friction-magnitude", 5).values()
    assert abs(bias) < 0.1


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", list_names(EXPERIMENTS))
def test_intervals_hold_the_truth(name: str) -> None:
    """Over 50 seeds: intervals of 90 % coverage contain the true value in at least 42 of 50 cases in 94 % of such
    studies."""
    for bias, coverage in recover(name, 50).values():
        assert coverage >= 0.84 and abs(bias) < 0.2


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
    changes = {"procedure.levels": [0.15], "procedure.repetitions": 2000, "observer.lapse": 0.0}
    experiment = Experiment(make_tables(confidence={}, factor=[]), changes)
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

        bounds = [*[(-5.0, 2.0)] * 2, np.log([0.5, 12.0])]
        best = [optimize.differential_evolution(loss, bounds[k:], rng=1, tol=1e-8).fun for k in (1, 0)]
        total += 2.0 * (best[0] - best[1])
    (comparison,) = compare_models(experiment.file, two)
    # Half a grid step, 1 % of a threshold and 4 % of a slope, costs some hundredths at each of the 4 maxima.
    assert comparison.chi_squared == pytest.approx(total, abs=0.1) and comparison.freedom == 2
    assert comparison.p_value == pytest.approx(stats.chi2.sf(comparison.chi_squared, 2)) and comparison.p_value < 0.001
    assert comparison.aic_difference == pytest.approx(comparison.chi_squared - 4.0)


def test_numbers_are_compared_by_regression() -> None:
    """With an intercept per condition chi squared is n log(RSS0 / RSS1), checked by NumPy's least squares."""
    task = {"kind": "rate", "parameter": "object.table.material.stiffness_n_per_m", "question": "?"}
    procedure = {"kind": "constant", "levels": [100.0, 300.0, 900.0], "repetitions": 6}
    experiment = Experiment(make_tables(task=task, procedure=procedure), {"observer.by": {"2.0": {"scale": 15.0}}})
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
    groups = analysis.fit_groups(experiment.file, rows)
    for population in estimate_population(groups):
        own = [group for group in groups if group.condition == population.condition]
        logs = np.log([group.fit.threshold for group in own if group.participant != analysis.ALL_PARTICIPANTS])
        assert population.mean == pytest.approx(np.exp(logs.mean()))
        assert population.interval_95 == pytest.approx(np.exp(stats.t.interval(0.95, 5, logs.mean(), stats.sem(logs))))


def test_ratios_are_within_participants(study: tuple[Experiment, list[dict[str, Any]]]) -> None:
    experiment, rows = study
    groups = analysis.fit_groups(experiment.file, rows)
    (ratio,) = compare_levels(experiment.file, groups, ["sub-06"])
    included = [group for group in groups if group.participant not in (analysis.ALL_PARTICIPANTS, "sub-06")]
    none, damped = ([np.log(g.fit.threshold) for g in included if g.condition == name] for name in ("0.0", "4.0"))
    paired = stats.ttest_rel(damped, none).confidence_interval()
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
    assert list(analysis.find_excluded_participants(experiment.file, rows)) == ["sub-03"]
    pooled = [
        group for group in analysis.fit_groups(experiment.file, rows) if group.participant == analysis.ALL_PARTICIPANTS
    ]
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
