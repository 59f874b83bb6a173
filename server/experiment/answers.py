"""Answers of a participant: by a key in the terminal, a button of the device, the page, or another program."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.server.experiment.design import Condition, Planned
from softfinger.server.experiment.haptics import Haptics
from softfinger.server.experiment.observer import Simulated
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.session import Felt, Given, Place, right
from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import Prompt

CHOICES: Final = ("first", "second")
KEYS: Final = {"1": "first", "2": "second"}
NUMBERS: Final = (1e-6, 1e6)
"""Range of an estimate, which is a number above 0."""
GO_ON: Final = "go on"
BEGIN: Final = "begin"
END: Final = "That was the last trial. Thank you."
LOOK_S: Final = 0.1
"""Period of polling the daemon for the answer."""


class Person:
    """Participant at the device. The first answer counts, from any source.

    Each question is a prompt of the daemon. Pages and other programs answer it by the command `answer`; this class does
    so for keys in the terminal and the first two buttons of the device.
    """

    def __init__(self, experiment: ExperimentFile, haptics: Haptics) -> None:
        self._experiment, self._haptics = experiment, haptics
        self._place: Place | None = None

    def instruct(self) -> None:
        """Show the instructions until the participant starts."""
        if text := self._experiment.instructions:
            self._asked(Prompt(self._experiment.title, text, choices=(BEGIN,)), f"{text} Enter or a button begins.")

    def follow(self, place: Place) -> None:
        self._place = place
        task = self._experiment.task
        self._show(self._prompt(task.question if task.kind == "trace" else place.text))

    def answer(self, trial: Planned, condition: Condition, level: float, felt: Felt) -> Given:
        task = self._experiment.task
        if task.kind == "trace":
            return Given(float(felt.summary.get("duration_s", 0.0)))
        if task.kind == "compare":
            prompt = self._prompt(task.question, choices=CHOICES)
            given = self._asked(prompt, f"{task.question} 1: the first, 2: the second")
            if trial.practice:
                self._tell_whether(right(trial, given.value))
            return given
        if task.scale is None:
            prompt = self._prompt(task.question, number=NUMBERS)
            return self._asked(prompt, f"{task.question} A number above 0, then Enter")
        ends = ", ".join(f"{mark}: {word}" for mark, word in zip(task.scale, task.scale_ends, strict=False))
        prompt = self._prompt(f"{task.question}\n{ends}", choices=task.marks)
        given = self._asked(prompt, f"{task.question} {ends} ({task.scale[0]} to {task.scale[1]}, then Enter)")
        return given._replace(value=float(given.value))

    def _tell_whether(self, is_right: bool) -> None:
        """Show whether the answer to a practice trial was right, so that the participant learns the question."""
        text = "That was right." if is_right else "That was wrong."
        self._asked(self._prompt(text, choices=(GO_ON,)), f"{text} Enter or a button goes on.")

    def pause(self, done: int, of: int) -> None:
        said_so_far = f"{done} of {of} trials are done."
        prompt = Prompt("A break", f"{said_so_far} Go on when you are ready.", done, of, (GO_ON,))
        self._asked(prompt, f"{said_so_far} A break: Enter or a button goes on.")

    def end(self) -> None:
        """Show that the session is over."""
        self._show(Prompt(self._experiment.title, END))

    def _prompt(self, text: str, **asked: Any) -> Prompt:
        place = self._place
        assert place is not None
        return Prompt(place.title, text, place.trial - 1, place.trials, **asked)

    def _show(self, prompt: Prompt) -> int:
        number: int = self._haptics.client.ask("set_prompt", prompt).number
        return number

    def _asked(self, prompt: Prompt, line: str) -> Given:
        """Ask on pages and with a line in the terminal, wait for the answer, and return it."""
        number, client = self._show(prompt), self._haptics.client
        pressed, typed = self._buttons(), ""
        with keyboard(single=is_single(prompt)) as keys:  # discards keys typed before the question
            said(line)
            while (found := client.get_prompt()).open and found.number == number:
                self._haptics.wait(LOOK_S)
                typed += keys()
                now = self._buttons()
                value, typed = meant(prompt, typed, now & ~pressed)
                pressed &= now  # a button that is already down must be released first
                if value is not None:
                    self._give(value, number)
        if found.number != number or found.answer is None:
            raise ConfigError("another program has set a prompt in the place of the question: let it end first")
        return Given(found.answer, found.after_s)

    def _give(self, value: str | float, number: int) -> None:
        try:
            self._haptics.client.answer(value, number)
        except CommandRefused as refused:
            said(str(refused))

    def _buttons(self) -> int:
        buttons = 0
        for sample in self._haptics.newest.values():
            buttons |= int(sample.data.buttons)
        return buttons


class DryRun:
    """Simulated observer in place of a participant."""

    def __init__(self, experiment: ExperimentFile, participant: int) -> None:
        self._observer = Simulated(experiment, participant)

    def follow(self, place: Place) -> None:
        """Do nothing: the simulated observer needs no prompt."""

    def answer(self, trial: Planned, condition: Condition, level: float, felt: Felt) -> Given:
        return Given(self._observer.answer(trial, condition, level))

    def pause(self, done: int, of: int) -> None:
        """Do nothing: the simulated observer needs no break."""


def is_single(prompt: Prompt) -> bool:
    """Return True if a single key answers the prompt."""
    return len(prompt.choices) == 1 or prompt.choices == CHOICES


def meant(prompt: Prompt, typed: str, buttons: int) -> tuple[str | float | None, str]:
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
    return (line.strip()[:64] if choices else parse_number(line)), rest


def said(line: str) -> None:
    """Print a line for the participant, independent of the log level."""
    print(line, flush=True)


@contextmanager
def keyboard(single: bool) -> Iterator[Any]:
    """Yield a function that returns the text typed since its last call.

    A terminal passes it on key by key if `single`, otherwise line by line.
    """
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor) if single and sys.stdin.isatty() else None
    ended = False

    def keys() -> str:
        nonlocal ended
        if ended or not select.select([descriptor], [], [], 0.0)[0]:
            return ""
        data = os.read(descriptor, 256)
        ended = not data
        return data.decode(errors="replace")

    try:
        if before is not None:
            tty.setcbreak(descriptor)
        yield keys
    finally:
        if before is not None:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
