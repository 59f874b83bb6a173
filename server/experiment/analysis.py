"""Analysis of answers: a psychometric function or a power law per condition, for each participant and for all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.design import conditions
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.psychometric import Fit, fit
from softfinger.server.experiment.schema import ExperimentFile

ALL: Final = "all participants"
FELT: Final = ("peak_force_n", "mean_force_n", "path_m", "duration_s")
"""Columns of the table of trials that are averaged by condition."""


class PowerLaw(NamedTuple):
    """answer = scale level^exponent, fitted to the logarithms by least squares (Stevens 1957), with 95 % intervals.

    middle  geometric mean of the levels; `answer` is the value of the line there, the typical answer of a condition
    noise   standard deviation of the logarithm of an answer around the line
    """

    scale: float
    exponent: float
    exponent_95: tuple[float, float]
    middle: float
    answer: float
    answer_95: tuple[float, float]
    noise: float


class Group(NamedTuple):
    """Answers of one participant, or of all, in one condition, and their fit.

    felt  mean and standard deviation of each column in FELT
    """

    participant: str
    condition: str
    trials: int
    fit: Fit | PowerLaw
    rows: list[Entry]
    felt: dict[str, tuple[float, float]]


def analysed(experiment: ExperimentFile, rows: Sequence[Entry]) -> list[Group]:
    """Fit the answers by condition in the order of the design, without practice trials.

    Returns the fits of each participant and, if there are several, of their pooled answers. The pooled fit describes an
    observer only if the participants differ little. Raises ConfigError if there are no answers.
    """
    counted = [row for row in rows if not row["practice"]]
    if not counted:
        raise ConfigError("no trial beyond practice has been answered: there is nothing to draw yet")
    people = sorted({row["participant"] for row in counted})
    groups = []
    for person in [*people, *([ALL] if len(people) > 1 else [])]:
        for condition in (each.name for each in conditions(experiment)):
            some = [row for row in counted if row["condition"] == condition and person in (ALL, row["participant"])]
            if some:
                groups.append(Group(person, condition, len(some), fitted(experiment, some), some, felt(some)))
    return groups


def fitted(experiment: ExperimentFile, rows: Sequence[Entry]) -> Fit | PowerLaw:
    """Fit the psychometric function of comparisons, or the power law of numbers."""
    levels = [row["level"] for row in rows]
    if experiment.task.kind == "compare":
        return fit(levels, [row["right"] for row in rows], experiment.observer.lapse)
    return power_law(levels, [row["answer"] for row in rows])


def power_law(levels: Sequence[float], answers: Sequence[float]) -> PowerLaw:
    """Fit a line to the logarithms of answers over levels.

    Parameters
    ----------
    levels, answers
        (n,) values above 0.

    Returns
    -------
    PowerLaw
        Intervals are Student's. Undetermined values are nan: the exponent of a single level, and the intervals of too
        few answers.
    """
    x, y = np.log(levels), np.log(answers)
    middle, answer, centred = float(x.mean()), float(y.mean()), x - x.mean()
    spread = float(centred @ centred)
    lines = 2 if len(set(levels)) > 1 else 1  # fitted parameters: the line, or only the mean
    exponent = float(centred @ y) / spread if lines == 2 else 0.0
    left, freedom = y - answer - exponent * centred, len(x) - lines
    noise = math.sqrt(float(left @ left) / freedom) if freedom > 0 else math.nan
    wide = student_975(freedom) * noise if freedom > 0 else math.nan
    half, around = wide / math.sqrt(spread) if lines == 2 else math.nan, wide / math.sqrt(len(x))
    return PowerLaw(
        scale=math.exp(answer - exponent * middle),
        exponent=exponent if lines == 2 else math.nan,
        exponent_95=(exponent - half, exponent + half),
        middle=math.exp(middle),
        answer=math.exp(answer),
        answer_95=(math.exp(answer - around), math.exp(answer + around)),
        noise=noise,
    )


def student_975(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t, by bisection of its distribution function.

    For integer degrees of freedom the function is a finite sum (Abramowitz and Stegun 1964, 26.7.3, 26.7.4).
    """
    low, high = 1.9, 13.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _inside(middle, freedom) < 0.95 else (low, middle)
    return 0.5 * (low + high)


def _inside(t: float, freedom: int) -> float:
    """Return the probability that Student's t is between -t and t."""
    angle = math.atan(t / math.sqrt(freedom))
    cosine, sine = math.cos(angle), math.sin(angle)
    odd = freedom % 2
    term = cosine if odd else 1.0
    total = term if freedom > 1 else 0.0
    for k in range(2 + odd, freedom - 1, 2):
        term *= cosine * cosine * (k - 1) / k
        total += term
    return 2.0 / math.pi * (angle + sine * total) if odd else sine * total


def felt(rows: Sequence[Entry]) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of the columns in FELT that the rows have."""
    columns = {name: np.array([row[name] for row in rows if name in row]) for name in FELT}
    return {name: (float(each.mean()), float(each.std())) for name, each in columns.items() if len(each)}


def said(found: Fit | PowerLaw) -> str:
    """Format a fit with its 95 % intervals."""
    if isinstance(found, Fit):
        unbounded = ", not bounded by the answers: take other levels or more trials" if found.bounded else ""
        return f"threshold {_ranged(found.threshold, found.threshold_95)}{unbounded}"
    answer = f"answer {_ranged(found.answer, found.answer_95)} at {found.middle:.3g}"
    return answer if math.isnan(found.exponent) else f"exponent {_ranged(found.exponent, found.exponent_95)}, {answer}"


def _ranged(value: float, interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{value:.3g}" if math.isnan(low) else f"{value:.3g} ({low:.3g} to {high:.3g})"


def table(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Return a row of plain numbers for each group."""
    made = []
    for group in groups:
        row: dict[str, Any] = {"participant": group.participant, "condition": group.condition, "trials": group.trials}
        for key, value in group.fit._asdict().items():
            if key == "curve":
                continue
            row |= {f"{key}_low": value[0], f"{key}_high": value[1]} if isinstance(value, tuple) else {key: value}
        for name, (mean, deviation) in group.felt.items():
            row |= {f"{name}_mean": mean, f"{name}_sd": deviation}
        made.append(row)
    return made
