"""What answers say: a psychometric function or a power law for each condition, of each participant and of all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.psychometric import Fit, fit
from softfinger.server.experiment.schema import ExperimentFile

ALL: Final = "all participants"
FELT: Final = ("peak_force_n", "mean_force_n", "path_m", "duration_s")
"""Columns of the table of trials that are averaged by condition."""


class PowerLaw(NamedTuple):
    """answer = scale level^exponent, fitted to the logarithms by least squares (Stevens 1957), with 95 % intervals.

    noise  standard deviation of the logarithm of an answer about the line
    """

    scale: float
    exponent: float
    exponent_95: tuple[float, float]
    noise: float


class Group(NamedTuple):
    """Answers of one participant, or of all, in one condition, and the fit to them.

    felt  mean of each column of what was felt, and its standard deviation
    """

    participant: str
    condition: str
    trials: int
    fit: Fit | PowerLaw
    rows: list[Entry]
    felt: dict[str, tuple[float, float]]


def analysed(experiment: ExperimentFile, rows: Sequence[Entry]) -> list[Group]:
    """Fits by condition, of each participant and, of several, of all together; practice left out.

    All together are fitted as one, which has an observer's meaning where participants differ little. ConfigError
    without an answer.
    """
    counted = [row for row in rows if not row["practice"]]
    if not counted:
        raise ConfigError("no trial beyond practice has been answered: there is nothing to draw yet")
    people = sorted({row["participant"] for row in counted})
    groups = []
    for person in [*people, *([ALL] if len(people) > 1 else [])]:
        for condition in dict.fromkeys(row["condition"] for row in counted):
            some = [row for row in counted if row["condition"] == condition and person in (ALL, row["participant"])]
            if some:
                groups.append(Group(person, condition, len(some), fitted(experiment, some), some, felt(some)))
    return groups


def fitted(experiment: ExperimentFile, rows: Sequence[Entry]) -> Fit | PowerLaw:
    """The psychometric function of comparisons, the power law of numbers."""
    levels = [row["level"] for row in rows]
    if experiment.task.kind == "compare":
        return fit(levels, [row["right"] for row in rows], experiment.observer.lapse)
    return power_law(levels, [row["answer"] for row in rows])


def power_law(levels: Sequence[float], answers: Sequence[float]) -> PowerLaw:
    """The line through the logarithms of answers (n,) over levels (n,), both above 0.

    The interval of the exponent is Student's, nan with fewer than three answers or a single level.
    """
    x, y = np.log(levels), np.log(answers)
    centred = x - x.mean()
    spread = float(centred @ centred)
    if len(x) < 3 or spread == 0.0:
        return PowerLaw(math.exp(y.mean()), math.nan, (math.nan, math.nan), float(y.std()))
    exponent = float(centred @ y) / spread
    left = y - y.mean() - exponent * centred
    noise = math.sqrt(float(left @ left) / (len(x) - 2))
    half = student_975(len(x) - 2) * noise / math.sqrt(spread)
    return PowerLaw(math.exp(y.mean() - exponent * x.mean()), exponent, (exponent - half, exponent + half), noise)


def student_975(freedom: int) -> float:
    """The 97.5 % quantile of Student's t, by the roots of its distribution function.

    For a whole number of degrees of freedom that function is a finite sum (Abramowitz and Stegun 1964, 26.7.3, 26.7.4).
    """
    low, high = 1.9, 13.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _inside(middle, freedom) < 0.95 else (low, middle)
    return 0.5 * (low + high)


def _inside(t: float, freedom: int) -> float:
    """Probability that Student's variable is from -t to t."""
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
    """Mean and standard deviation of what was felt, of the columns that the rows have."""
    columns = {name: np.array([row[name] for row in rows if name in row]) for name in FELT}
    return {name: (float(each.mean()), float(each.std())) for name, each in columns.items() if len(each)}


def table(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """A row of plain numbers for each group."""
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
