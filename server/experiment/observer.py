"""Simulated observer of a dry run: random answers, reproducible for each trial."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from softfinger.server.experiment.design import TRIAL, Condition, PlannedTrial
from softfinger.server.experiment.psychometric import probability
from softfinger.server.experiment.schema import ExperimentFile, Observer


def observer_for(experiment: ExperimentFile, condition: Condition) -> Observer:
    """Return the observer in a condition: values of the condition replace the general ones."""
    return msgspec.structs.replace(experiment.observer, **experiment.observer.by.get(condition.name, {}))


class SimulatedObserver:
    """Answers of a participant with the properties of [observer], determined by the seed and the trial's number."""

    def __init__(self, experiment: ExperimentFile, participant: int) -> None:
        self._experiment, self._participant = experiment, participant

    def answer(self, trial: PlannedTrial, condition: Condition, level: float) -> str | float:
        """Return `first` or `second` for a comparison, else a number."""
        rng = np.random.default_rng([self._experiment.design.seed, self._participant, TRIAL, trial.number])
        observer = observer_for(self._experiment, condition)
        if self._experiment.task.kind == "compare":
            right = rng.random() < float(probability(level, observer.threshold, observer.slope, lapse=observer.lapse))
            return "first" if right == trial.test_first else "second"
        answer = observer.scale * math.pow(level, observer.exponent) * math.exp(observer.noise * rng.standard_normal())
        scale = self._experiment.task.scale
        return answer if scale is None else float(min(max(round(answer), scale[0]), scale[1]))
