"""Analyse the folder of an experiment with pandas and SciPy: thresholds by condition, with bootstrapped intervals.

    softfinger experiment curvature-by-rolling --dry-run --no-daemon --out curvature
    python examples/analyse_experiment.py curvature curvature.png

Needs pandas, SciPy and matplotlib. `softfinger figure` does much the same in one command; begin here for a model of
your own.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.optimize import minimize

LAPSE = 0.02  # share of wrong answers however large the difference
RESAMPLED = 200


def chance(level: np.ndarray, threshold: float, slope: float) -> np.ndarray:
    """Probability of a right answer: half by chance, then a Weibull function."""
    return 0.5 + (0.5 - LAPSE) * -np.expm1(-((level / threshold) ** slope))


def threshold_of(trials: pd.DataFrame) -> tuple[float, float]:
    """Threshold and slope of the greatest likelihood, slopes expected about 1.8."""
    level, right = trials["level"].to_numpy(), trials["right"].to_numpy(bool)

    def loss(logs: np.ndarray) -> float:
        p = np.clip(chance(level, *np.exp(logs)), 1e-9, 1.0 - 1e-9)
        return -np.log(np.where(right, p, 1.0 - p)).sum() + 0.5 * ((logs[1] - np.log(1.8)) / 0.5) ** 2

    bounds = [(np.log(level.min() / 4), np.log(level.max() * 4)), (np.log(0.5), np.log(12))]
    return tuple(np.exp(minimize(loss, [np.log(np.median(level)), np.log(1.8)], bounds=bounds).x))


def main(folder: str, picture: str) -> None:
    trials = pd.read_csv(f"{folder}/trials.csv")
    trials = trials[~trials["practice"]]
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for condition, some in trials.groupby("condition"):
        threshold, slope = threshold_of(some)
        again = [threshold_of(some.sample(frac=1.0, replace=True, random_state=k))[0] for k in range(RESAMPLED)]
        low, high = np.percentile(again, [2.5, 97.5])
        print(f"{condition}: threshold {threshold:.3f} ({low:.3f} to {high:.3f}), {len(some)} trials")
        x = np.geomspace(some["level"].min(), some["level"].max(), 60)
        (line,) = axes.plot(x, chance(x, threshold, slope), label=condition)
        share = some.groupby("level")["right"].agg(["mean", "count"])
        axes.scatter(share.index, share["mean"], 8.0 * np.sqrt(share["count"]), color=line.get_color())
    axes.set(xscale="log", xlabel="difference, as a share of the reference", ylabel="share of right answers")
    axes.legend()
    figure.savefig(picture)


if __name__ == "__main__":
    main(*sys.argv[1:3])
