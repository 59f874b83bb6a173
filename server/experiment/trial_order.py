"""Order of trials from the factors of a design.

Each random choice is determined by the seed and the participant's number, so that the order is reproducible.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from msgspec.structs import replace

from softfinger.server.experiment.schema import ExperimentFile, Observer
from softfinger.server.experiment.schema_parts import Screen

T = TypeVar("T")
V = TypeVar("V", Observer, Screen)

_ORDER: Final = 1
"""Stream of random numbers for the order; TRIAL: for each trial; SURVEY: for each answer of a survey.

_ADDITIONS is the stream for catch trials, staircases and balance by level, so that a file without them has the same
order as before there were any.
"""
TRIAL: Final = 2
SURVEY: Final = 3
_ADDITIONS: Final = 4


class Condition(NamedTuple):
    """Combination of factor levels.

    name     levels of all factors, "all" without factors
    levels   by factor
    scene    scene of the condition, None: the experiment's
    changes  parameters by dotted path
    """

    name: str
    levels: dict[str, float | str]
    scene: str | None
    changes: dict[str, Any]


class PlannedTrial(NamedTuple):
    """Trial of the design.

    number      from 1
    practice    True if the trial does not count
    condition   index in the list of conditions
    level       None: chosen by a procedure at the time of the trial
    test_first  True if the first of two touches is the test stimulus, not the reference
    catch       True for a catch trial
    staircase   number of the interleaved staircase, from 1; 0: there is at most one
    """

    number: int
    practice: bool
    condition: int
    level: float | None
    test_first: bool
    catch: bool = False
    staircase: int = 0


def list_conditions(experiment: ExperimentFile) -> list[Condition]:
    """Return all combinations of the factors' levels; the level of the last factor changes fastest."""
    combinations = []
    for levels in itertools.product(*(factor.levels for factor in experiment.factor)):
        scene, changes = None, dict[str, Any]()
        for factor, level in zip(experiment.factor, levels, strict=True):
            scene = factor.scenes.get(str(level), scene)
            changes |= {factor.parameter: level} if factor.parameter else factor.values.get(str(level), {})
        names = [str(level) for level in levels]
        by_factor = dict(zip((factor.name for factor in experiment.factor), levels, strict=True))
        combinations.append(Condition(", ".join(names) or "all", by_factor, scene, changes))
    return combinations


def choose_by_condition(table: V, condition: Condition) -> V:
    """Return [observer] or [screen] in a condition: values of the condition replace the general ones."""
    return replace(table, **table.by.get(condition.name, {}))


def make_williams_row(count: int, row: int) -> list[int]:
    """Return a row of a Latin square in which each of `count` items follows each other equally often (Williams 1949).

    An odd count needs two squares, the second being the mirror image of the first: rows repeat after 2 count.
    """
    first = [0, *itertools.chain.from_iterable(zip(range(1, count), range(count - 1, 0, -1), strict=True))][:count]
    line = [(position + row) % count for position in first]
    return line[::-1] if count % 2 and row // count % 2 else line


def plan_trials(experiment: ExperimentFile, participant: int) -> list[PlannedTrial]:
    """Return the trials of a participant, practice first."""
    rng = np.random.default_rng([experiment.design.seed, participant, _ORDER])
    count = len(list_conditions(experiment))
    blocks = [_make_block(experiment, condition, rng) for condition in range(count)]
    match experiment.design.order:
        case "random":
            trials = _mix(blocks, rng)
        case "latin-square":
            trials = [trial for index in make_williams_row(count, participant - 1) for trial in blocks[index]]
        case _:
            trials = [trial for block in blocks for trial in block]
    practice = [trials[int(k)] for k in rng.integers(len(trials), size=experiment.design.practice)]
    all_trials = [(True, trial) for trial in practice] + [(False, trial) for trial in trials]
    first = rng.permutation(len(all_trials)) % 2 == 0  # balanced
    planned = [
        PlannedTrial(k + 1, is_practice, *trial, bool(first[k])) for k, (is_practice, trial) in enumerate(all_trials)
    ]
    rng = np.random.default_rng([experiment.design.seed, participant, _ADDITIONS])
    planned = _insert_catch_trials(experiment, _interleave(experiment, planned, rng), rng)
    if experiment.design.test_first == "balanced-by-level":
        planned = _balance_by_level(planned, rng)
    return [trial._replace(number=k) for k, trial in enumerate(planned, 1)]


def describe_session(experiment: ExperimentFile) -> list[tuple[str, str]]:
    """Return rows of name and text that describe a session for the participant."""
    trials, trial = plan_trials(experiment, 1), experiment.trial
    touches = 1 + (experiment.task.kind == "compare")
    minutes = len(trials) * touches * (trial.touch_s + trial.gap_s) / 60.0
    every = experiment.design.break_every
    return [
        ("scene, rig", f"{experiment.scene}, {experiment.rig}"),
        ("conditions", "; ".join(condition.name for condition in list_conditions(experiment))),
        ("trials", f"{len(trials)}, {experiment.design.practice} of them practice; {experiment.procedure.kind}"),
        ("lasts", f"{minutes:.0f} min and the answers" + (f", a break after each {every} trials" if every else "")),
    ]


def _make_block(experiment: ExperimentFile, condition: int, rng: np.random.Generator) -> list[tuple[int, float | None]]:
    """Return the trials of a condition: its index, and the level if it is known."""
    procedure = experiment.procedure
    if procedure.kind != "constant":
        return [(condition, None)] * procedure.trials
    levels = [level for _ in range(procedure.repetitions) for level in _shuffle(procedure.levels, rng)]
    return [(condition, level) for level in levels]


def _mix(
    blocks: Sequence[Sequence[tuple[int, float | None]]], rng: np.random.Generator
) -> list[tuple[int, float | None]]:
    """Return the trials of all blocks in random order; the order within each block is unchanged."""
    block_order = _shuffle([index for index, block in enumerate(blocks) for _ in block], rng)
    remaining = [iter(block) for block in blocks]
    return [next(remaining[index]) for index in block_order]


def _interleave(
    experiment: ExperimentFile, trials: Sequence[PlannedTrial], rng: np.random.Generator
) -> list[PlannedTrial]:
    """Assign the trials of each condition to its staircases, in rounds of all of them in random order."""
    count = len(experiment.procedure.starts)
    if not count:
        return list(trials)
    rounds = dict[int, list[int]]()
    assigned = []
    for trial in trials:
        if trial.practice:
            assigned.append(trial._replace(staircase=1))
            continue
        remaining = rounds.setdefault(trial.condition, [])
        remaining.extend([] if remaining else _shuffle(range(1, count + 1), rng))
        assigned.append(trial._replace(staircase=remaining.pop()))
    return assigned


def _insert_catch_trials(
    experiment: ExperimentFile, trials: Sequence[PlannedTrial], rng: np.random.Generator
) -> list[PlannedTrial]:
    """Insert catch trials after randomly chosen trials of their condition, half of them with the test first."""
    if experiment.catch is None:
        return list(trials)
    after = Counter[int]()
    for condition in range(len(list_conditions(experiment))):
        numbers = [trial.number for trial in trials if trial.condition == condition and not trial.practice]
        after.update(int(k) for k in rng.choice(numbers, round(experiment.catch.rate * len(numbers)), replace=False))
    first = iter(rng.permutation(after.total()) % 2 == 0)
    mixed = []
    for trial in trials:
        mixed.append(trial)
        if trial.number in after:
            catch = trial._replace(level=experiment.catch.level, test_first=bool(next(first)), catch=True, staircase=0)
            mixed.append(catch)
    return mixed


def _balance_by_level(trials: Sequence[PlannedTrial], rng: np.random.Generator) -> list[PlannedTrial]:
    """Let half of the trials of each condition and level begin with the test; an odd one is drawn."""
    groups = dict[tuple[int, float | None, bool, bool, int], list[int]]()
    for index, trial in enumerate(trials):
        group = (trial.condition, trial.level, trial.practice, trial.catch, trial.staircase)
        groups.setdefault(group, []).append(index)
    balanced = list(trials)
    for indices in groups.values():
        odd = int(rng.integers(2))
        for place, index in zip(rng.permutation(len(indices)), indices, strict=True):
            balanced[index] = trials[index]._replace(test_first=bool((place + odd) % 2))
    return balanced


def _shuffle(values: Sequence[T], rng: np.random.Generator) -> list[T]:
    return [values[int(index)] for index in rng.permutation(len(values))]
