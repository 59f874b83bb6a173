"""Interfaces between a session, the presenter of its stimuli and its source of answers."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from softfinger.server.experiment.schema_parts import Question
from softfinger.server.experiment.trial_order import Condition, PlannedTrial


class Stimulus(NamedTuple):
    """Stimulus of a touch.

    trial, touch  number of the trial, and of the touch in it, from 1
    scene         scene of the condition, None: the experiment's
    changes       parameters by dotted path
    """

    trial: int
    touch: int
    scene: str | None
    changes: dict[str, Any]


class Progress(NamedTuple):
    """Progress of a session.

    trial, trials    number of the trial, and of all
    block, blocks    the same for the block
    practice         True if the trial does not count
    touch, touches   number of the touch in the trial, and of all in it
    """

    trial: int
    trials: int
    block: int
    blocks: int
    practice: bool
    touch: int
    touches: int

    @property
    def title(self) -> str:
        """Trial and block for the participant; omits the condition."""
        block = f"Block {self.block} of {self.blocks}, " if self.blocks > 1 else ""
        return f"{block}{'trial' if block else 'Trial'} {self.trial} of {self.trials}{', practice' * self.practice}"

    @property
    def text(self) -> str:
        """Number of the next touch, if there are several."""
        return f"Touch {self.touch} of {self.touches}" if self.touches > 1 else ""


class TouchResult(NamedTuple):
    """Result of a touch: numbers for the table of trials, and every tick; both empty without a daemon."""

    summary: dict[str, Any]
    ticks: list[dict[str, Any]]


class Response(NamedTuple):
    """Response: `first` or `second` of a comparison, else a number; and the response time (s), if known."""

    value: str | float
    after_s: float | None = None


class AnswerSource(Protocol):
    def instruct(self) -> None:
        """Show the instructions until the participant starts."""

    def prepare(self, progress: Progress, condition: Condition) -> None:
        """Prepare for the next touch."""

    def answer(self, trial: PlannedTrial, condition: Condition, level: float, result: TouchResult) -> Response:
        """Return the answer to a trial, after its touches."""

    def confidence(self, trial: PlannedTrial, condition: Condition, level: float, question: Question) -> Response:
        """Return the confidence in the answer to a trial."""

    def ask(
        self, title: str, question: Question, condition: Condition | None, number: int, place: tuple[int, int]
    ) -> Response:
        """Return the answer to a question that belongs to no trial.

        number  of the question in the session
        place   number of questions before it in its survey, and of all in the survey
        """

    def pause(self, completed: int, total: int) -> None:
        """Wait until the participant continues."""
