"""Psychometric function of a comparison, and the posterior of its threshold and slope from answers."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from softfinger.config.arrays import Array

GUESS: Final = 0.5
"""Probability of a right answer by chance, one of two touches."""
SLOPES: Final = np.geomspace(0.5, 12.0, 40)
"""Grid of slopes: no observer is flatter than the first, and the last is almost a step."""
SLOPE: Final = 1.8
SLOPE_SD: Final = 0.7
"""Prior of the slope: its logarithm is normal with mean log(SLOPE) and this standard deviation."""
THRESHOLDS: Final = 300
LOG_LIKELIHOOD_DROP: Final = 1.920729410347062
"""Half of the 95 % quantile of chi squared with one degree of freedom.

An end of the grid is excluded if its log likelihood is below the maximum by more than this.
"""
QUANTILES: Final = (0.025, 0.5, 0.975)
MIN_RELATIVE_WEIGHT: Final = 1e-7
"""Grid points with a smaller weight relative to the best one are omitted from the curve."""
THRESHOLD_MARGIN: Final = 4.0
"""The grid of thresholds extends from the lowest level over this to the highest level times this."""


def compute_probability(
    level: ArrayLike, threshold: ArrayLike, slope: ArrayLike, guess: float = GUESS, lapse: float = 0.0
) -> Array:
    """Return the probability of a right answer, a Weibull function of the level: guess + (1 - guess - lapse) F.

    F = 1 - exp(-(level / threshold)^slope), hence 63 % of the range at the threshold. The arguments are broadcast.
    """
    scaled = np.power(np.asarray(level, np.float64) / np.asarray(threshold, np.float64), slope)
    chance: Array = guess + (1.0 - guess - lapse) * -np.expm1(-np.minimum(scaled, 700.0))
    return chance


class Fit(NamedTuple):
    """Threshold and slope, medians with 95 % intervals (low, high), and the function with its band.

    log_likelihood  maximum, including the prior of the slope
    bounded         the answers do not exclude an end of the grid of thresholds
    curve           (n, 4): level, probability, and the 95 % interval of the probability
    """

    threshold: float
    threshold_95: tuple[float, float]
    slope: float
    slope_95: tuple[float, float]
    log_likelihood: float
    bounded: bool
    curve: Array


def fit(levels: ArrayLike, right: ArrayLike, lapse: float, points: int = 60) -> Fit:
    """Fit the Weibull function to answers (n,) at levels (n,) with a given lapse rate.

    Parameters
    ----------
    levels, right
        (n,) level of each trial, and whether its answer was right.
    lapse
        Fraction of wrong answers at the highest levels.
    points
        Number of levels in the curve of the result.

    Returns
    -------
    Fit
        Medians, and central 95 % intervals, of the posterior on a grid of 300 thresholds by 40 slopes.

    Raises
    ------
    ValueError
        If there are no answers.

    Notes
    -----
    The prior is uniform in the threshold's logarithm and normal in the slope's. Levels of an adaptive procedure are
    close together and carry little information on the slope: with only the most likely slope the interval of the
    threshold would be too short, and without a prior the threshold too low (Kaernbach, Perception and Psychophysics 63
    (2001) 1389-1398).

    Source: Kuss, Jaekel and Wichmann, Journal of Vision 5 (2005) 478-492.
    """
    thresholds, likelihood = log_likelihoods(levels, right, lapse)
    unique_levels = np.unique(np.asarray(levels, np.float64))
    threshold, slope = np.meshgrid(thresholds, SLOPES, indexing="ij")
    likelihood -= 0.5 * (np.log(slope / SLOPE) / SLOPE_SD) ** 2
    best = likelihood.max()
    weight = np.exp(likelihood - best)
    low, middle, high = np.exp(_compute_quantiles(np.log(thresholds), weight.sum(axis=1)))
    flat, slope_middle, steep = np.exp(_compute_quantiles(np.log(SLOPES), weight.sum(axis=0)))
    likely = weight > MIN_RELATIVE_WEIGHT
    x = np.geomspace(unique_levels[0], unique_levels[-1], points) if len(unique_levels) > 1 else unique_levels
    curves = compute_probability(x[:, None], threshold[likely], slope[likely], GUESS, lapse)
    band = np.array([_compute_quantiles(row, weight[likely]) for row in curves])
    return Fit(
        float(middle),
        (float(low), float(high)),
        float(slope_middle),
        (float(flat), float(steep)),
        float(best),
        bool(likelihood[[0, -1]].max() >= best - LOG_LIKELIHOOD_DROP),
        np.column_stack([x, band[:, 1], band[:, 0], band[:, 2]]),
    )


def log_likelihoods(levels: ArrayLike, right: ArrayLike, lapse: float) -> tuple[Array, Array]:
    """Return the grid of thresholds (300,), and the log likelihood of answers (300, 40) on it and on SLOPES.

    Raises ValueError if there are no answers.
    """
    unique_levels, index = np.unique(np.asarray(levels, np.float64), return_inverse=True)
    if not len(unique_levels):
        raise ValueError("no answers: nothing to fit")
    correct = np.bincount(index, np.asarray(right, np.float64))
    wrong = np.bincount(index) - correct
    thresholds = np.geomspace(unique_levels[0] / THRESHOLD_MARGIN, unique_levels[-1] * THRESHOLD_MARGIN, THRESHOLDS)
    threshold, slope = np.meshgrid(thresholds, SLOPES, indexing="ij")
    chance = np.clip(
        compute_probability(unique_levels, threshold[..., None], slope[..., None], GUESS, lapse), 1e-9, 1.0 - 1e-9
    )
    return thresholds, np.log(chance) @ correct + np.log1p(-chance) @ wrong


def _compute_quantiles(values: Array, weights: Array) -> Array:
    """Return the QUANTILES of values (n,) with weights (n,)."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    quantiles: Array = np.interp(QUANTILES, share / weights.sum(), values[order])
    return quantiles
