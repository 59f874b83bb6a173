"""Staircases, QUEST+ and maximum likelihood fits against closed forms and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from softfinger.server.experiment.analysis import compute_student_975, fit_power_law, format_fit
from softfinger.server.experiment.procedures import GRID_POINTS, QuestPlus, Staircase
from softfinger.server.experiment.psychometric import QUANTILES, SLOPE, SLOPE_SD, SLOPES, compute_probability, fit
from softfinger.server.experiment.schema_trials import Procedure

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
        assert estimate.bounded and "not bounded by the answers" in format_fit(estimate)
        assert (estimate.threshold < min(levels)) if answers else (estimate.threshold > max(levels))


def test_students_quantile_is_scipys() -> None:
    for freedom in (1, 2, 3, 4, 5, 10, 31, 200):
        assert compute_student_975(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), abs=1e-10)


def test_a_power_law_is_a_line_of_logarithms() -> None:
    rng = np.random.default_rng(4)
    levels = np.repeat([0.1, 0.3, 0.9], 5)
    answers = 10.0 * levels**0.8 * np.exp(0.2 * rng.standard_normal(15))
    line, estimate = stats.linregress(np.log(levels), np.log(answers)), fit_power_law(levels, answers)
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
    estimate = fit_power_law([0.5] * 3, answers)
    mean = stats.t.interval(0.95, 2, np.log(answers).mean(), stats.sem(np.log(answers)))
    assert np.isnan(estimate.exponent) and estimate.answer_95 == pytest.approx(np.exp(mean))
    assert format_fit(estimate) == f"answer 11.1 ({estimate.answer_95[0]:.3g} to {estimate.answer_95[1]:.3g}) at 0.5"
    assert format_fit(fit_power_law([0.5], [9.0])) == "answer 9 at 0.5"
