"""Simulated observer of a dry run: random answers, reproducible for each trial."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Final

import numpy as np

from softfinger.server.experiment.interfaces import Progress, Response, TouchResult
from softfinger.server.experiment.psychometric import compute_probability
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.schema_parts import Question
from softfinger.server.experiment.trial_order import SURVEY, TRIAL, Condition, PlannedTrial, choose_by_condition

CERTAIN_EVIDENCE: Final = 2.0
"""Smallest evidence, in standard deviations of its noise, for the highest rating of confidence."""
RATING_NOISE: Final = 0.1
"""Standard deviation of the answers to likert questions and numbers, as a share of their range."""


class SimulatedObserver:
    """Answers of a participant with the properties of [observer], determined by the seed and the trial's number.

    An `AnswerSource`; it needs neither instructions nor prompts nor breaks.
    """

    def __init__(self, experiment: ExperimentFile, participant: int) -> None:
        self._experiment, self._participant = experiment, participant

    def instruct(self) -> None: ...

    def prepare(self, progress: Progress, condition: Condition) -> None: ...

    def pause(self, completed: int, total: int) -> None: ...

    def answer(self, trial: PlannedTrial, condition: Condition, level: float, result: TouchResult) -> Response:
        rng = self._make_rng(TRIAL, trial.number)
        observer = choose_by_condition(self._experiment.observer, condition)
        if self._experiment.task.kind == "compare":
            right = rng.random() < float(
                compute_probability(level, observer.threshold, observer.slope, lapse=observer.lapse)
            )
            return Response("first" if right == trial.test_first else "second")
        answer = observer.scale * math.pow(level, observer.exponent) * math.exp(observer.noise * rng.standard_normal())
        scale = self._experiment.task.scale
        return Response(answer if scale is None else float(min(max(round(answer), scale[0]), scale[1])))

    def confidence(self, trial: PlannedTrial, condition: Condition, level: float, question: Question) -> Response:
        """Return the mark of confidence in the answer to a comparison.

        Signal detection: evidence x is normal with unit variance, and the answer is right if x > 0. The range of |x|
        from 0 to CERTAIN_EVIDENCE has equal parts for all marks. The random number is that of the answer.
        """
        observer, normal = choose_by_condition(self._experiment.observer, condition), NormalDist()
        chance = float(compute_probability(level, observer.threshold, observer.slope, lapse=observer.lapse))
        uniform = self._make_rng(TRIAL, trial.number).random()
        evidence = normal.inv_cdf(min(chance, 1.0 - 1e-12)) - normal.inv_cdf(max(uniform, 1e-300))
        marks = question.marks
        return Response(float(marks[min(int(abs(evidence) / CERTAIN_EVIDENCE * len(marks)), len(marks) - 1)]))

    def ask(
        self, title: str, question: Question, condition: Condition | None, number: int, place: tuple[int, int]
    ) -> Response:
        return Response(self.survey(question, condition, number))

    def survey(self, question: Question, condition: Condition | None, number: int) -> str | float:
        """Return the answer to a question of a survey; its number in the session determines its noise."""
        answers = dict(self._experiment.observer.answers)
        if condition is not None:
            answers |= choose_by_condition(self._experiment.observer, condition).answers
        configured = answers.get(question.name)
        if question.kind == "text":
            return "simulated" if configured is None else str(configured)
        if question.kind == "multi-choice":
            return question.options[0] if configured is None else str(configured)
        mean = 0.5 * (question.min + question.max) if configured is None else float(configured)
        noise = RATING_NOISE * (question.max - question.min) * self._make_rng(SURVEY, number).standard_normal()
        answer = min(max(mean + noise, question.min), question.max)
        if question.kind == "number":
            return min(max(float(round(answer)), question.min), question.max)
        return question.min + question.step * round((answer - question.min) / question.step)

    def _make_rng(self, stream: int, number: int) -> np.random.Generator:
        return np.random.default_rng([self._experiment.design.seed, self._participant, stream, number])
