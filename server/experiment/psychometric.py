"""The psychometric function of a comparison, and what answers say of it: maximum likelihood with profile intervals."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

GUESS: Final = 0.5
"""Of two touches one is right by chance."""
SLOPES: Final = np.geomspace(0.5, 12.0, 40)
"""Slopes that are looked at: flatter nobody answers, steeper is a step."""
SLOPE: Final = 1.8
SLOPE_SD: Final = 0.5
"""What a slope is thought to be before the answers: its logarithm normal about that of SLOPE."""
THRESHOLDS: Final = 300
LIKELY: Final = 1.920729410347062
"""Half of the 95 % quantile of chi squared with one degree of freedom."""
MARGIN: Final = 4.0
"""Thresholds are sought from the least level over this to the largest level times this."""


def probability(
    level: ArrayLike, threshold: ArrayLike, slope: ArrayLike, guess: float = GUESS, lapse: float = 0.0
) -> Array:
    """Probability of a right answer, by a Weibull function of the level: guess + (1 - guess - lapse) F.

    F = 1 - exp(-(level / threshold)^slope), so 63 % of the way at the threshold. The arguments are broadcast.
    """
    reached = np.power(np.asarray(level, np.float64) / np.asarray(threshold, np.float64), slope)
    chance: Array = guess + (1.0 - guess - lapse) * -np.expm1(-np.minimum(reached, 700.0))
    return chance


class Fit(NamedTuple):
    """Threshold and slope with 95 % intervals (low, high), and the function with its band.

    log_likelihood  the highest, penalised
    curve   (n, 4): level, probability, and the 95 % interval of the probability
    bounded  the threshold's interval reaches an end of what was looked at: the answers do not bound it
    """

    threshold: float
    threshold_95: tuple[float, float]
    slope: float
    slope_95: tuple[float, float]
    log_likelihood: float
    bounded: bool
    curve: Array

    def as_map(self) -> dict[str, Any]:
        """Plain values, without the curve."""
        return {key: value for key, value in self._asdict().items() if key != "curve"}


def fit(levels: ArrayLike, right: ArrayLike, lapse: float, points: int = 60) -> Fit:
    """Fit the Weibull function to answers (n,) at levels (n,), the lapse rate being given.

    The likelihood is penalised by what slopes are thought to be: answers of an adaptive procedure stand close together
    and say little of the slope, and maximum likelihood alone takes it too steep and the threshold too low (Kaernbach,
    Perception and Psychophysics 63 (2001) 1389-1398). Intervals are those of the profile likelihood: what some pair of
    threshold and slope has within 1.92 of the highest. So is the band of the curve, point by point. Both come from one
    grid of 300 thresholds by 40 slopes.

    Source: Wichmann and Hill, Perception and Psychophysics 63 (2001) 1293-1313, for the model; Venzon and Moolgavkar,
    Applied Statistics 37 (1988) 87-94, for the intervals. ValueError without answers.
    """
    each, place = np.unique(np.asarray(levels, np.float64), return_inverse=True)
    if not len(each):
        raise ValueError("no answers: nothing to fit")
    correct = np.bincount(place, np.asarray(right, np.float64))
    wrong = np.bincount(place) - correct
    thresholds = np.geomspace(each[0] / MARGIN, each[-1] * MARGIN, THRESHOLDS)
    threshold, slope = np.meshgrid(thresholds, SLOPES, indexing="ij")
    chance = np.clip(probability(each, threshold[..., None], slope[..., None], GUESS, lapse), 1e-9, 1.0 - 1e-9)
    likelihood = np.log(chance) @ correct + np.log1p(-chance) @ wrong
    likelihood -= 0.5 * (np.log(slope / SLOPE) / SLOPE_SD) ** 2
    best = np.unravel_index(np.argmax(likelihood), likelihood.shape)
    likely = likelihood >= likelihood[best] - LIKELY
    x = np.geomspace(each[0], each[-1], points) if len(each) > 1 else each
    curves = probability(x, threshold[likely][:, None], slope[likely][:, None], GUESS, lapse)
    curve = probability(x, threshold[best], slope[best], GUESS, lapse)
    low, high = float(threshold[likely].min()), float(threshold[likely].max())
    return Fit(
        float(threshold[best]),
        (low, high),
        float(slope[best]),
        (float(slope[likely].min()), float(slope[likely].max())),
        float(likelihood[best]),
        bool(low <= thresholds[0] or high >= thresholds[-1]),
        np.column_stack([x, curve, curves.min(axis=0), curves.max(axis=0)]),
    )
