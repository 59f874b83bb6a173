"""Simulated observer of a dry run: random answers, reproducible for each trial."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from softfinger.server.experiment.design import TRIAL, Condition, Planned
from softfinger.server.experiment.psychometric import probability
from softfinger.server.experiment.schema import ExperimentFile, Observer


def observer_in(experiment: ExperimentFile, condition: Condition) -> Observer:
    """Return the observer in a condition: values of the condition replace the general ones."""
    return msgspec.structs.replace(experiment.observer, **experiment.observer.by.get(condition.name, {}))


class Simulated:
    """Answers of a participant with the properties of [observer], determined by the seed and the trial's number."""

    def __init__(self, experiment: ExperimentFile, participant: int) -> None:
        self._experiment, self._participant = experiment, participant

    def answer(self, trial: Planned, condition: Condition, level: float) -> str | float:
        """Return `first` or `second` for a comparison, else a number."""
        rng = np.random.default_rng([self._experiment.design.seed, self._participant, TRIAL, trial.number])
        who = observer_in(self._experiment, condition)
        if self._experiment.task.kind == "compare":
            right = rng.random() < float(probability(level, who.threshold, who.slope, lapse=who.lapse))
            return "first" if right == trial.test_first else "second"
        said = who.scale * math.pow(level, who.exponent) * math.exp(who.noise * rng.standard_normal())
        scale = self._experiment.task.scale
        return said if scale is None else float(min(max(round(said), scale[0]), scale[1]))
