"""Comparison of models with and without a factor, and estimates over participants."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from softfinger.server.experiment.analysis import ALL_PARTICIPANTS, Group, PowerLaw, compute_student_975, is_counted
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.psychometric import log_likelihoods
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.trial_order import list_conditions


class Comparison(NamedTuple):
    """Likelihood-ratio test of a factor.

    parameters      of the models with and without the factor, over all participants
    log_likelihood  maxima of the two models
    chi_squared     twice the difference of the maxima
    freedom         difference of the parameters
    p_value         probability of a larger `chi_squared` if the factor has no effect
    aic_difference  Akaike's criterion without the factor less that with it: above 0 favours the factor
    """

    factor: str
    parameters: tuple[int, int]
    log_likelihood: tuple[float, float]
    chi_squared: float
    freedom: int
    p_value: float
    aic_difference: float


def compare_models(
    experiment: ExperimentFile, rows: Sequence[Entry], excluded: Collection[str] = ()
) -> list[Comparison]:
    """Compare the model of all conditions with the models in which a factor has no effect, for each factor.

    Factors with answers at fewer than two of their levels are left out. So are practice and catch trials of `rows`, and
    `excluded` participants.

    Notes
    -----
    Each participant has a threshold in each condition and one slope; for numbers and durations, an intercept in each
    condition, one exponent and one noise. Without a factor, conditions that differ only in it share the threshold or
    intercept. Twice the difference of the log likelihoods is chi-squared distributed (Wilks, Annals of Mathematical
    Statistics 9 (1938) 60-62). Thresholds and slopes are those of the grid of `fit`, without its prior.
    """
    by_participant = dict[str, list[Entry]]()
    for row in rows:
        if is_counted(row) and row["participant"] not in excluded:
            by_participant.setdefault(row["participant"], []).append(row)
    names = [factor.name for factor in experiment.factor]
    comparisons = []
    for factor in names:
        remaining_factors = [name for name in names if name != factor]
        with_factor, without = (
            [_maximize_likelihood(experiment, answers, keys) for answers in by_participant.values()]
            for keys in (names, remaining_factors)
        )
        parameters = sum(count for count, _ in with_factor), sum(count for count, _ in without)
        maxima = math.fsum(value for _, value in with_factor), math.fsum(value for _, value in without)
        freedom = parameters[0] - parameters[1]
        if freedom > 0:
            chi_squared = max(2.0 * (maxima[0] - maxima[1]), 0.0)  # the two models have grids of different steps
            p_value = compute_chi_squared_tail(chi_squared, freedom)
            comparisons.append(
                Comparison(factor, parameters, maxima, chi_squared, freedom, p_value, chi_squared - 2.0 * freedom)
            )
    return comparisons


def _maximize_likelihood(experiment: ExperimentFile, rows: Sequence[Entry], keys: Sequence[str]) -> tuple[int, float]:
    """Return the number of parameters and the maximum of the log likelihood of a participant's answers.

    keys  factors that have an effect
    """
    groups = dict[tuple[Any, ...], list[Entry]]()
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    if experiment.task.kind == "compare":
        total = sum(
            log_likelihoods(
                [row["level"] for row in group], [row["right"] for row in group], experiment.observer.lapse
            )[1].max(axis=0)
            for group in groups.values()
        )
        return len(groups) + 1, float(np.max(total))
    y = np.log([row["answer"] for group in groups.values() for row in group])
    columns = np.repeat(np.eye(len(groups)), [len(group) for group in groups.values()], axis=0)
    levels = np.log([row["level"] for group in groups.values() for row in group])
    if len(set(levels)) > 1:
        columns = np.column_stack([columns, levels])
    residuals = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    variance = max(float(residuals @ residuals) / len(y), 1e-300)
    return columns.shape[1] + 1, -0.5 * len(y) * (math.log(2.0 * math.pi * variance) + 1.0)


def compute_chi_squared_tail(value: float, freedom: int) -> float:
    """Return the probability that chi squared is above a value.

    For integer degrees of freedom it is a finite sum (Abramowitz and Stegun 1964, 26.4.4, 26.4.5).
    """
    half = 0.5 * value
    if half == 0.0:
        return 1.0
    start = freedom % 2
    tail = math.erfc(math.sqrt(half)) if start else math.exp(-half)
    orders = (0.5 * k for k in range(start or 2, freedom, 2))
    return min(
        tail + math.fsum(math.exp(order * math.log(half) - half - math.lgamma(order + 1.0)) for order in orders), 1.0
    )


class Estimate(NamedTuple):
    """Estimate of a condition over participants: geometric mean with Student's 95 % interval."""

    condition: str
    participants: int
    mean: float
    interval_95: tuple[float, float]


def estimate_population(groups: Sequence[Group], excluded: Collection[str] = ()) -> list[Estimate]:
    """Return the geometric mean over participants of the threshold, or of the answer, in each condition."""
    values = dict[str, list[float]]()
    for (_, condition), value in _group_values(groups, excluded).items():
        values.setdefault(condition, []).append(value)
    estimates = []
    for condition, level_values in values.items():
        mean, (low, high) = compute_mean_interval(list(map(math.log, level_values)))
        estimates.append(Estimate(condition, len(level_values), math.exp(mean), (math.exp(low), math.exp(high))))
    return estimates


class Effect(NamedTuple):
    """Effect of a level of a factor against its first level, within participants: mean with Student's 95 % interval.

    value  ratio of thresholds or answers (geometric mean), or difference of scores
    """

    factor: str
    level: str
    baseline: str
    participants: int
    value: float
    interval_95: tuple[float, float]


def compare_levels(experiment: ExperimentFile, groups: Sequence[Group], excluded: Collection[str] = ()) -> list[Effect]:
    """Return the ratio of the threshold, or of the answer, at each level of a factor to that at its first level."""
    values = {key: math.log(value) for key, value in _group_values(groups, excluded).items()}
    return [
        effect._replace(
            value=math.exp(effect.value), interval_95=(math.exp(effect.interval_95[0]), math.exp(effect.interval_95[1]))
        )
        for effect in compute_level_differences(experiment, values)
    ]


def compute_level_differences(experiment: ExperimentFile, values: Mapping[tuple[str, str], float]) -> list[Effect]:
    """Return the mean difference between each level of a factor and its first level.

    values  by participant and condition

    Differences are of conditions that differ only in the factor, averaged over these for each participant. Participants
    without a value in one of the conditions are left out.
    """
    participants = list(dict.fromkeys(participant for participant, _ in values))
    designed, effects = list_conditions(experiment), list[Effect]()
    for factor in experiment.factor:
        name, baseline = factor.name, factor.levels[0]
        for level in factor.levels[1:]:
            pairs = [
                (condition.name, base.name)
                for condition in designed
                for base in designed
                if condition.levels[name] == level and base.levels == condition.levels | {name: baseline}
            ]
            differences = [
                float(
                    np.mean([values[participant, condition] - values[participant, base] for condition, base in pairs])
                )
                for participant in participants
                if all((participant, condition) in values for pair in pairs for condition in pair)
            ]
            if differences:
                mean, interval = compute_mean_interval(differences)
                effects.append(Effect(name, str(level), str(baseline), len(differences), mean, interval))
    return effects


def compute_mean_interval(values: Sequence[float]) -> tuple[float, tuple[float, float]]:
    mean, count = float(np.mean(values)), len(values)
    margin = (
        compute_student_975(count - 1) * float(np.std(values, ddof=1)) / math.sqrt(count) if count > 1 else math.nan
    )
    return mean, (mean - margin, mean + margin)


def _group_values(groups: Sequence[Group], excluded: Collection[str]) -> dict[tuple[str, str], float]:
    return {
        (group.participant, group.condition): (
            group.fit.answer if isinstance(group.fit, PowerLaw) else group.fit.threshold
        )
        for group in groups
        if group.participant != ALL_PARTICIPANTS and group.participant not in excluded
    }
