"""Answers of a participant: by a key in the terminal, a button of the device, the page, or another program."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.server.experiment.design import Condition, PlannedTrial
from softfinger.server.experiment.files import screen_for
from softfinger.server.experiment.haptics import Haptics
from softfinger.server.experiment.observer import SimulatedObserver
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.schema_parts import Question
from softfinger.server.experiment.session import Answer, Progress, TouchResult, is_right_answer
from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import TEXT_ANSWER_MAX, Prompt

CHOICES: Final = ("first", "second")
KEYS: Final = {"1": "first", "2": "second"}
NUMBERS: Final = (1e-6, 1e6)
"""Range of an estimate, which is a number above 0."""
CONTINUE: Final = "go on"
BEGIN: Final = "begin"
END: Final = "That was the last trial. Thank you."
POLL_S: Final = 0.1
"""Period of polling the daemon for the answer."""
RELEASE_S: Final = 0.7
"""Time without input after which no key is held: keyboards repeat a held key after 660 ms at most."""
RELEASE: Final = "Release the key."


class Participant:
    """Participant at the device. The first answer counts, from any source.

    Each question is a prompt of the daemon. Pages and other programs answer it by the command `answer`; this class does
    so for keys in the terminal and the first two buttons of the device.

    images  data URIs of the images of the page, by name
    """

    def __init__(self, experiment: ExperimentFile, haptics: Haptics, images: Mapping[str, str]) -> None:
        self._experiment, self._haptics, self._images = experiment, haptics, images
        self._progress: Progress | None = None
        self._last_key_s = 0.0
        self._screen: dict[str, Any] = {}

    def instruct(self) -> None:
        """Show the instructions until the participant starts."""
        if text := self._experiment.instructions:
            self._ask(
                Prompt(self._experiment.title, text, choices=(BEGIN,)), f"{text} Press Enter or a button to start."
            )

    def prepare(self, progress: Progress, condition: Condition) -> None:
        self._progress = progress
        screen = screen_for(self._experiment, condition)
        self._screen = {
            "masking_noise": screen.masking_noise,
            "volume": screen.volume,
            "colour": screen.colour,
            "image": self._images.get(screen.image, ""),
        }
        task = self._experiment.task
        self._show(self._prompt(task.question if task.kind == "trace" else progress.text))

    def answer(self, trial: PlannedTrial, condition: Condition, level: float, result: TouchResult) -> Answer:
        task = self._experiment.task
        if task.kind == "trace":
            return Answer(float(result.summary.get("duration_s", 0.0)))
        if task.kind == "compare":
            prompt = self._prompt(task.question, choices=CHOICES)
            answer = self._ask(prompt, f"{task.question} 1: the first, 2: the second")
            if trial.practice:
                self._show_feedback(is_right_answer(trial, answer.value))
            return answer
        if task.scale is None:
            prompt = self._prompt(task.question, number=NUMBERS)
            return self._ask(prompt, f"{task.question} A number above 0, then Enter")
        ends = ", ".join(f"{mark}: {word}" for mark, word in zip(task.scale, task.scale_ends, strict=False))
        prompt = self._prompt(f"{task.question}\n{ends}", choices=task.marks)
        answer = self._ask(prompt, f"{task.question} {ends} ({task.scale[0]} to {task.scale[1]}, then Enter)")
        return answer._replace(value=float(answer.value))

    def confidence(self, trial: PlannedTrial, condition: Condition, level: float, question: Question) -> Answer:
        progress = self._progress
        assert progress is not None
        return self.ask(progress.title, question, condition, trial.number)

    def ask(self, title: str, question: Question, condition: Condition | None, number: int) -> Answer:
        line = question.text
        if question.kind == "text":
            return self._ask(Prompt(title, line, text_length=TEXT_ANSWER_MAX), f"{line} A text, then Enter")
        if question.kind == "number":
            limits = question.min, question.max
            return self._ask(
                Prompt(title, line, number=limits), f"{line} A number from {limits[0]:g} to {limits[1]:g}, then Enter"
            )
        if question.kind == "likert":
            answer = self._ask(
                Prompt(title, line, choices=question.marks), f"{line} One of {', '.join(question.marks)}, then Enter"
            )
            return answer._replace(value=float(answer.value))
        return self._ask(
            Prompt(title, line, choices=question.options), f"{line} One of {', '.join(question.options)}, then Enter"
        )

    def _show_feedback(self, is_right: bool) -> None:
        """Show whether the answer to a practice trial was right, so that the participant learns the question."""
        text = "That was right." if is_right else "That was wrong."
        self._ask(self._prompt(text, choices=(CONTINUE,)), f"{text} Press Enter or a button to continue.")

    def pause(self, done: int, of: int) -> None:
        done_text = f"{done} of {of} trials are done."
        prompt = Prompt("A break", f"{done_text} Go on when you are ready.", done, of, (CONTINUE,))
        self._ask(prompt, f"{done_text} A break: Press Enter or a button to continue.")

    def end(self) -> None:
        """Show the debriefing until the participant has read it, and then that the session is over."""
        if text := self._experiment.debriefing:
            self._ask(Prompt(self._experiment.title, text, choices=(CONTINUE,)), f"{text} Enter or a button goes on.")
        self._show(Prompt(self._experiment.title, END))

    def _prompt(self, text: str, **options: Any) -> Prompt:
        progress = self._progress
        assert progress is not None
        return Prompt(progress.title, text, progress.trial - 1, progress.trials, **self._screen, **options)

    def _show(self, prompt: Prompt) -> int:
        number: int = self._haptics.client.ask("set_prompt", prompt).number
        return number

    def _ask(self, prompt: Prompt, line: str) -> Answer:
        """Ask on pages and with a line in the terminal, wait for the answer, and return it."""
        client, typed, single = self._haptics.client, "", is_single(prompt)
        with keyboard(single) as keys:  # discards keys typed before the question
            if single and sys.stdin.isatty():
                self._wait_for_release(keys)
            number, held_buttons = self._show(prompt), self._buttons()
            print_line(line)
            while (prompted := client.get_prompt()).open and prompted.number == number:
                self._haptics.wait(POLL_S)
                typed += keys()
                buttons = self._buttons()
                value, typed = parse_answer(prompt, typed, buttons & ~held_buttons)
                held_buttons &= buttons  # a button that is already down must be released first
                if value is not None:
                    self._last_key_s = time.monotonic()
                    self._send_answer(value, number)
        if prompted.number != number or prompted.answer is None:
            raise ConfigError("another program has set a prompt in the place of the question: let it end first")
        return Answer(prompted.answer, prompted.after_s)

    def _wait_for_release(self, keys: Callable[[], str]) -> None:
        """Wait until no key of the terminal is held, because a held key would answer every question."""
        is_told = False
        while True:
            self._haptics.wait(POLL_S)
            if keys():
                self._last_key_s = time.monotonic()
                if not is_told:
                    print_line(RELEASE)
                is_told = True
            elif time.monotonic() - self._last_key_s > RELEASE_S:
                return

    def _send_answer(self, value: str | float, number: int) -> None:
        try:
            self._haptics.client.answer(value, number)
        except CommandRefused as refused:
            print_line(str(refused))

    def _buttons(self) -> int:
        buttons = 0
        for sample in self._haptics.latest.values():
            buttons |= int(sample.data.buttons)
        return buttons


class DryRun:
    """Simulated observer in place of a participant."""

    def __init__(self, experiment: ExperimentFile, participant: int) -> None:
        self._observer = SimulatedObserver(experiment, participant)

    def instruct(self) -> None:
        """Do nothing: the simulated observer needs no instructions."""

    def confidence(self, trial: PlannedTrial, condition: Condition, level: float, question: Question) -> Answer:
        return Answer(self._observer.confidence(trial, condition, level, question))

    def ask(self, title: str, question: Question, condition: Condition | None, number: int) -> Answer:
        return Answer(self._observer.survey(question, condition, number))

    def prepare(self, progress: Progress, condition: Condition) -> None:
        """Do nothing: the simulated observer needs no prompt."""

    def answer(self, trial: PlannedTrial, condition: Condition, level: float, result: TouchResult) -> Answer:
        return Answer(self._observer.answer(trial, condition, level))

    def pause(self, done: int, of: int) -> None:
        """Do nothing: the simulated observer needs no break."""


def is_single(prompt: Prompt) -> bool:
    """Return True if a single key answers the prompt."""
    return len(prompt.choices) == 1 or prompt.choices == CHOICES


def parse_answer(prompt: Prompt, typed: str, buttons: int) -> tuple[str | float | None, str]:
    """Return the answer that the typed text and newly pressed buttons mean, or None, and the unused text.

    With one choice, any key or button answers. With CHOICES, the keys 1 and 2 and the first two buttons do. All other
    prompts take a line.
    """
    choices = prompt.choices
    if len(choices) == 1:
        return (choices[0] if typed or buttons else None), ""
    if choices == CHOICES:
        keys = [KEYS[key] for key in typed if key in KEYS]
        return (keys[0] if keys else CHOICES[0] if buttons & 1 else CHOICES[1] if buttons & 2 else None), ""
    line, newline, rest = typed.partition("\n")
    if not newline or not line.strip():
        return None, rest if newline else line
    if prompt.text_length:
        return line.strip()[: prompt.text_length], rest
    return (line.strip()[:64] if choices else parse_number(line)), rest


def print_line(line: str) -> None:
    """Print a line for the participant, independent of the log level."""
    print(line, flush=True)


@contextmanager
def keyboard(single: bool) -> Iterator[Callable[[], str]]:
    """Yield a function that returns the text typed since its last call.

    A terminal passes it on key by key if `single`, otherwise line by line.
    """
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor) if single and sys.stdin.isatty() else None
    is_at_end = False

    def keys() -> str:
        nonlocal is_at_end
        if is_at_end or not select.select([descriptor], [], [], 0.0)[0]:
            return ""
        data = os.read(descriptor, 256)
        is_at_end = not data
        return data.decode(errors="replace")

    try:
        if before is not None:
            tty.setcbreak(descriptor)
        yield keys
    finally:
        if before is not None:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
