"""Order of trials from the factors of a design.

Each random choice is determined by the seed and the participant's number, so that the order is reproducible.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from softfinger.server.experiment.schema import ExperimentFile

T = TypeVar("T")

_ORDER: Final = 1
"""Stream of random numbers for the order; TRIAL: for each trial."""
TRIAL: Final = 2


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
    """

    number: int
    practice: bool
    condition: int
    level: float | None
    test_first: bool


def conditions(experiment: ExperimentFile) -> list[Condition]:
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


def williams(count: int, row: int) -> list[int]:
    """Return a row of a Latin square in which each of `count` items follows each other equally often (Williams 1949).

    An odd count needs two squares, the second being the mirror image of the first: rows repeat after 2 count.
    """
    first = [0, *itertools.chain.from_iterable(zip(range(1, count), range(count - 1, 0, -1), strict=True))][:count]
    line = [(each + row) % count for each in first]
    return line[::-1] if count % 2 and row // count % 2 else line


def plan_trials(experiment: ExperimentFile, participant: int) -> list[PlannedTrial]:
    """Return the trials of a participant, practice first."""
    rng = np.random.default_rng([experiment.design.seed, participant, _ORDER])
    count = len(conditions(experiment))
    blocks = [_block(experiment, condition, rng) for condition in range(count)]
    match experiment.design.order:
        case "random":
            trials = _mix(blocks, rng)
        case "latin-square":
            trials = [trial for index in williams(count, participant - 1) for trial in blocks[index]]
        case _:
            trials = [trial for block in blocks for trial in block]
    practice = [trials[int(k)] for k in rng.integers(len(trials), size=experiment.design.practice)]
    all_trials = [(True, trial) for trial in practice] + [(False, trial) for trial in trials]
    first = rng.permutation(len(all_trials)) % 2 == 0  # balanced
    return [
        PlannedTrial(k + 1, is_practice, *trial, bool(first[k])) for k, (is_practice, trial) in enumerate(all_trials)
    ]


def summary(experiment: ExperimentFile) -> list[tuple[str, str]]:
    """Return rows of name and text that describe a session for the participant."""
    trials, trial = plan_trials(experiment, 1), experiment.trial
    touches = 1 + (experiment.task.kind == "compare")
    minutes = len(trials) * touches * (trial.touch_s + trial.gap_s) / 60.0
    every = experiment.design.break_every
    return [
        ("scene, rig", f"{experiment.scene}, {experiment.rig}"),
        ("conditions", "; ".join(condition.name for condition in conditions(experiment))),
        ("trials", f"{len(trials)}, {experiment.design.practice} of them practice; {experiment.procedure.kind}"),
        ("lasts", f"{minutes:.0f} min and the answers" + (f", a break after each {every} trials" if every else "")),
    ]


def _block(experiment: ExperimentFile, condition: int, rng: np.random.Generator) -> list[tuple[int, float | None]]:
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


def _shuffle(values: Sequence[T], rng: np.random.Generator) -> list[T]:
    return [values[int(index)] for index in rng.permutation(len(values))]
