"""Analysis of answers: a psychometric function or a power law per condition, for each participant and for all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.psychometric import Fit, fit
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.trial_order import list_conditions
from softfinger.server.progress import show_progress

ALL_PARTICIPANTS: Final = "all participants"
AVERAGED_COLUMNS: Final = ("peak_force_n", "mean_force_n", "path_m", "duration_s")
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

    means  mean and standard deviation of each column in AVERAGED_COLUMNS
    """

    participant: str
    condition: str
    trials: int
    fit: Fit | PowerLaw
    rows: list[Entry]
    means: dict[str, tuple[float, float]]


def fit_groups(experiment: ExperimentFile, rows: Sequence[Entry]) -> list[Group]:
    """Fit the answers by condition in the order of the design, without practice and catch trials.

    Returns the fits of each participant and, if there are several, of their pooled answers, without the excluded
    participants. The pooled fit describes an observer only if the participants differ little. Raises ConfigError if
    there are no answers.
    """
    counted = [row for row in rows if is_counted(row)]
    excluded = find_excluded_participants(experiment, rows)
    if not counted:
        raise ConfigError("no trial after the practice has an answer yet: nothing to plot")
    participants = sorted({row["participant"] for row in counted})
    if len(participants) > max(1, len(excluded)):
        participants.append(ALL_PARTICIPANTS)
    pairs = [(participant, item.name) for participant in participants for item in list_conditions(experiment)]
    groups = []
    with show_progress("fitting", len(pairs)) as update:
        for number, (participant, condition) in enumerate(pairs):
            update(number)
            group_rows = [
                row
                for row in counted
                if row["condition"] == condition
                and (
                    row["participant"] == participant
                    or (participant == ALL_PARTICIPANTS and row["participant"] not in excluded)
                )
            ]
            if group_rows:
                fitted, means = fit_answers(experiment, group_rows), average_columns(group_rows)
                groups.append(Group(participant, condition, len(group_rows), fitted, group_rows, means))
    return groups


def is_counted(row: Entry) -> bool:
    """Return True for a trial that is neither practice nor a catch trial."""
    return not (row["practice"] or row.get("catch"))


def catch_shares(rows: Sequence[Entry]) -> dict[str, tuple[int, int]]:
    shares = dict[str, tuple[int, int]]()
    for row in rows:
        if row.get("catch") and not row["practice"]:
            right, count = shares.get(row["participant"], (0, 0))
            shares[row["participant"]] = right + bool(row["right"]), count + 1
    return shares


def find_excluded_participants(experiment: ExperimentFile, rows: Sequence[Entry]) -> dict[str, str]:
    if experiment.catch is None:
        return {}
    limit = experiment.catch.min_right
    return {
        participant: f"{right} of {count} catch trials correct, fewer than {limit:.0%}"
        for participant, (right, count) in catch_shares(rows).items()
        if right < limit * count
    }


def fit_answers(experiment: ExperimentFile, rows: Sequence[Entry]) -> Fit | PowerLaw:
    """Fit the psychometric function of comparisons, or the power law of numbers."""
    levels = [row["level"] for row in rows]
    if experiment.task.kind == "compare":
        return fit(levels, [row["right"] for row in rows], experiment.observer.lapse)
    return fit_power_law(levels, [row["answer"] for row in rows])


def fit_power_law(levels: Sequence[float], answers: Sequence[float]) -> PowerLaw:
    """Fit a line to the logarithms of answers (n,) over levels (n,), all above 0.

    Intervals are Student's. Undetermined values are nan: the exponent of a single level, and the intervals of too few
    answers.
    """
    x, y = np.log(levels), np.log(answers)
    middle, answer, centred = float(x.mean()), float(y.mean()), x - x.mean()
    spread = float(centred @ centred)
    parameter_count = 2 if len(set(levels)) > 1 else 1  # fitted parameters: the line, or only the mean
    exponent = float(centred @ y) / spread if parameter_count == 2 else 0.0
    residuals, freedom = y - answer - exponent * centred, len(x) - parameter_count
    noise = math.sqrt(float(residuals @ residuals) / freedom) if freedom > 0 else math.nan
    scaled_noise = compute_student_975(freedom) * noise if freedom > 0 else math.nan
    exponent_margin, answer_margin = (
        scaled_noise / math.sqrt(spread) if parameter_count == 2 else math.nan,
        scaled_noise / math.sqrt(len(x)),
    )
    return PowerLaw(
        scale=math.exp(answer - exponent * middle),
        exponent=exponent if parameter_count == 2 else math.nan,
        exponent_95=(exponent - exponent_margin, exponent + exponent_margin),
        middle=math.exp(middle),
        answer=math.exp(answer),
        answer_95=(math.exp(answer - answer_margin), math.exp(answer + answer_margin)),
        noise=noise,
    )


def compute_student_975(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t, by bisection of its distribution function.

    For integer degrees of freedom the function is a finite sum (Abramowitz and Stegun 1964, 26.7.3, 26.7.4).
    """
    low, high = 1.9, 13.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _compute_central_probability(middle, freedom) < 0.95 else (low, middle)
    return 0.5 * (low + high)


def _compute_central_probability(t: float, freedom: int) -> float:
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


def average_columns(rows: Sequence[Entry]) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of the columns in AVERAGED_COLUMNS that the rows have."""
    columns = {name: np.array([row[name] for row in rows if name in row]) for name in AVERAGED_COLUMNS}
    return {name: (float(values.mean()), float(values.std())) for name, values in columns.items() if len(values)}


def format_fit(result: Fit | PowerLaw) -> str:
    if isinstance(result, Fit):
        unbounded = ", not bounded by the answers: use other levels or more trials" if result.bounded else ""
        return f"threshold {format_interval(result.threshold, result.threshold_95)}{unbounded}"
    answer = f"answer {format_interval(result.answer, result.answer_95)} at {result.middle:.3g}"
    return (
        answer
        if math.isnan(result.exponent)
        else f"exponent {format_interval(result.exponent, result.exponent_95)}, {answer}"
    )


def format_interval(value: float, interval: tuple[float, float]) -> str:
    """Format a value with its interval, if there is one."""
    low, high = interval
    return f"{value:.3g}" if math.isnan(low) else f"{value:.3g} ({low:.3g} to {high:.3g})"


def make_table(groups: Sequence[Group]) -> list[dict[str, Any]]:
    rows_by_group = []
    for group in groups:
        row: dict[str, Any] = {"participant": group.participant, "condition": group.condition, "trials": group.trials}
        for key, value in group.fit._asdict().items():
            if key == "curve":
                continue
            row |= {f"{key}_low": value[0], f"{key}_high": value[1]} if isinstance(value, tuple) else {key: value}
        for name, (mean, deviation) in group.means.items():
            row |= {f"{name}_mean": mean, f"{name}_sd": deviation}
        rows_by_group.append(row)
    return rows_by_group
