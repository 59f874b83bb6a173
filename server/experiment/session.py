"""Session: the unanswered trials of one participant, in order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from softfinger.config.errors import HapticError
from softfinger.server.experiment.folder import ParticipantFolder
from softfinger.server.experiment.interfaces import AnswerSource, Progress, Response, Stimulus, TouchResult
from softfinger.server.experiment.journal import Entry, MemoryJournal
from softfinger.server.experiment.procedures import make_procedures
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.schema_parts import Question, Survey
from softfinger.server.experiment.trial_order import Condition, PlannedTrial, list_conditions, plan_trials

AGREE: Final = "I agree"
DECLINE: Final = "I do not agree"
CONSENT: Final = "consent"
"""Name of the question of consent, for the simulated observer."""


class Stopped(HapticError):
    """End of a session on request, before its last trial; a new start resumes at that trial."""

    exit_code = 0


class Session:
    """Trials of a participant; `report` receives progress lines for the experimenter."""

    def __init__(
        self, experiment: ExperimentFile, participant: int, report: Callable[[str], None] = lambda line: None
    ) -> None:
        self.experiment: Final = experiment
        self.conditions: Final = list_conditions(experiment)
        self.trials: Final = plan_trials(experiment, participant)
        self._report = report
        self._blocks = number_blocks(self.trials, experiment.design.order == "random")
        self._procedures = [make_procedures(experiment.procedure, experiment.observer.lapse) for _ in self.conditions]

    def welcome(self, journal: MemoryJournal, answers: AnswerSource) -> None:
        """Ask for consent, raising Stopped without it, and the first surveys; then show the instructions."""
        if self.experiment.consent and not any(entry["agreed"] for entry in journal.entries_of("consent")):
            answer = answers.ask(self.experiment.title, make_consent_question(self.experiment), None, 0, (0, 0))
            journal.write("consent", agreed=answer.value == AGREE)
            if answer.value != AGREE:
                raise Stopped("the participant did not agree: no trial was run")
        self._ask_surveys("before", 0, journal, answers)
        answers.instruct()

    def run(
        self,
        journal: MemoryJournal,
        present: Callable[[Stimulus], TouchResult],
        answers: AnswerSource,
        folder: ParticipantFolder | None = None,
    ) -> None:
        """Run the trials without an answer in the journal; the procedures first receive the earlier answers.

        present  presents a stimulus, from zero force to zero force
        """
        answered = {entry["trial"]: entry for entry in journal.entries_of("done")}
        started = [entry["trial"] for entry in journal.entries_of("begun")]
        for trial in self.trials:
            if trial.number in answered:
                self._update_procedure(trial, answered[trial.number])
                continue
            block = self._blocks[trial.number - 1]
            if trial.number > 1 and block != self._blocks[trial.number - 2]:
                self._ask_surveys("between", block - 1, journal, answers)
            attempt = 1 + started.count(trial.number)
            if attempt == 1:
                self._pause_if_due(trial, answers)
            journal.write("begun", trial=trial.number, attempt=attempt)
            entry, ticks = self._run_trial(trial, attempt, present, answers)
            if folder is not None and ticks:
                folder.ticks(trial.number, attempt, ticks)
            journal.write("done", **entry)
            self._update_procedure(trial, entry)
        self._ask_surveys("after", self._blocks[-1], journal, answers)
        if not journal.entries_of("finished"):
            journal.write("finished", trials=len(self.trials))

    def _ask_surveys(self, at: str, block: int, journal: MemoryJournal, answers: AnswerSource) -> None:
        """Ask the questions that are due and have no answer in the journal.

        block  number of the block that has ended, 0: none
        """
        block_conditions = [
            trial.condition for trial, number in zip(self.trials, self._blocks, strict=True) if number == block
        ]
        is_by_block = block_conditions and self.experiment.design.order != "random"
        answered = {(entry["survey"], entry["block"], entry["question"]) for entry in journal.entries_of("survey")}
        for survey in self.experiment.survey:
            condition = self.conditions[block_conditions[-1]] if is_by_block and "between" in survey.at else None
            for question_index, question in enumerate(survey.question if at in survey.at else ()):
                if (survey.name, block, question.name) in answered:
                    continue
                number = 1 + len(journal.entries_of("survey"))
                title, place = survey.title or self.experiment.title, (question_index, len(survey.question))
                answer = answers.ask(title, question, condition, number, place)
                journal.write("survey", **_survey_entry(survey, question, at, block, condition, answer))

    def _pause_if_due(self, trial: PlannedTrial, answers: AnswerSource) -> None:
        every, completed = self.experiment.design.break_every, trial.number - 1 - self.experiment.design.practice
        if (every and completed > 0 and completed % every == 0) or (completed == 0 and trial.number > 1):
            answers.pause(trial.number - 1, len(self.trials))

    def _run_trial(
        self, trial: PlannedTrial, attempt: int, present: Callable[[Stimulus], TouchResult], answers: AnswerSource
    ) -> tuple[Entry, list[dict[str, Any]]]:
        condition, task = self.conditions[trial.condition], self.experiment.task
        level = trial.level
        if level is None:
            level = self._procedures[trial.condition][trial.staircase].level()
        values = [task.value(level)]
        if task.reference is not None:
            values.insert(1 if trial.test_first else 0, task.reference)
        results = []
        for touch, value in enumerate(values, 1):
            progress = self._make_progress(trial, touch, len(values))
            self._report(f"{progress.title}{f': {progress.text}' if progress.text else ''}")
            answers.prepare(progress, condition)
            changes = condition.changes | list_parameters(self.experiment, value)
            results.append(present(Stimulus(trial.number, touch, condition.scene, changes)))
        test = results[0 if trial.test_first or len(results) == 1 else 1]
        answer, after_s = answers.answer(trial, condition, level, test)
        entry = {
            "trial": trial.number,
            "practice": trial.practice,
            "condition": condition.name,
            "levels": condition.levels,
            "level": level,
            "value": task.value(level),
            "test_first": trial.test_first,
            "answer": answer,
            "right": is_right_answer(trial, answer) if task.kind == "compare" else None,
            "attempt": attempt,
        } | ({} if after_s is None else {"answer_s": after_s})
        if trial.staircase:
            entry["staircase"] = trial.staircase
        if self.experiment.catch is not None:
            entry["catch"] = trial.catch
        if self.experiment.confidence is not None:
            confidence = answers.confidence(trial, condition, level, self.experiment.confidence.as_question)
            entry["confidence"] = float(confidence.value)
        ticks = [{"touch": touch} | row for touch, result in enumerate(results, 1) for row in result.ticks]
        return entry | test.summary, ticks

    def _make_progress(self, trial: PlannedTrial, touch: int, touches: int) -> Progress:
        block = self._blocks[trial.number - 1]
        return Progress(trial.number, len(self.trials), block, self._blocks[-1], trial.practice, touch, touches)

    def _update_procedure(self, trial: PlannedTrial, entry: Entry) -> None:
        procedure = self._procedures[trial.condition].get(trial.staircase)
        if procedure is not None and not trial.practice and not trial.catch:
            procedure.update(entry["level"], entry["right"])


def make_consent_question(experiment: ExperimentFile) -> Question:
    return Question(name=CONSENT, kind="multi-choice", prompt=experiment.consent, options=(AGREE, DECLINE))


def _survey_entry(
    survey: Survey, question: Question, at: str, block: int, condition: Condition | None, answer: Response
) -> Entry:
    return {
        "survey": survey.name, "at": at, "block": block, "condition": None if condition is None else condition.name,
        "question": question.name, "answer": answer.value,
    } | ({} if answer.after_s is None else {"answer_s": answer.after_s})  # fmt: skip


def number_blocks(trials: Sequence[PlannedTrial], is_mixed: bool) -> list[int]:
    """Return the number of each trial's block, from 1: consecutive trials of one condition, or all if `is_mixed`.

    Practice trials belong to the block that follows them.
    """
    block, numbers, last = 1, list[int](), None
    for trial in trials:
        if not (is_mixed or trial.practice):
            block += last not in (None, trial.condition)
            last = trial.condition
        numbers.append(block)
    return numbers


def list_parameters(experiment: ExperimentFile, value: float) -> dict[str, Any]:
    also: Mapping[str, float] = experiment.task.also
    return {experiment.task.parameter: value} | {path: factor * value for path, factor in also.items()}


def is_right_answer(trial: PlannedTrial, answer: str | float) -> bool:
    """Return True if the answer to a comparison names the test stimulus, not the reference."""
    return (answer == "first") == trial.test_first
