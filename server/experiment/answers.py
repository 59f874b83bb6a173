"""Answers of a participant: by a key in the terminal, a button of the device, or a mark that a client sends."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from softfinger.server.experiment.design import Condition, Planned
from softfinger.server.experiment.haptics import SLICE_S, Haptics
from softfinger.server.experiment.observer import Simulated
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.session import Felt

CHOICES: Final = ("first", "second")
KEYS: Final = {"1": "first", "2": "second"}
NUMBER_MAX: Final = 1e6


class Person:
    """A participant at the device. Whatever answers first counts.

    A comparison takes the keys 1 and 2, the device's first two buttons, and marks `answer` whose value is first or
    second. A number is typed, or is the value of a mark.
    """

    def __init__(self, experiment: ExperimentFile, haptics: Haptics) -> None:
        self._experiment, self._haptics = experiment, haptics

    def answer(self, trial: Planned, condition: Condition, level: float, felt: Felt) -> str | float:
        task = self._experiment.task
        if task.kind == "trace":
            return float(felt.summary.get("duration_s", 0.0))
        choice = task.kind == "compare"
        self._haptics.answers.clear()
        pressed, typed = self._buttons(), ""
        with keyboard(single=choice) as keys:  # which forgets what was typed before the question
            said(f"{task.question} {'1: the first, 2: the second' if choice else 'A number above 0, then Enter'}")
            while True:
                self._haptics.wait(SLICE_S)
                typed += keys()
                now = self._buttons()
                answer = chosen(typed, now & ~pressed) if choice else number(typed)
                pressed &= now  # one that was down has to be let go first
                for value in self._haptics.answers:
                    answer = answer or (
                        value if choice and value in CHOICES else None if choice else number(f"{value}\n")
                    )
                self._haptics.answers.clear()
                if answer is not None:
                    return answer
                if choice:
                    typed = ""
                elif "\n" in typed:
                    said("that is no number above 0")
                    typed = typed.rpartition("\n")[2]

    def pause(self, done: int, of: int) -> None:
        self._haptics.answers.clear()
        pressed = self._buttons()
        with keyboard(single=True) as keys:
            said(f"{done} of {of} trials are done. A break: Enter, a button or a mark `answer` goes on.")
            while not (keys() or self._buttons() & ~pressed or self._haptics.answers):
                self._haptics.wait(SLICE_S)

    def _buttons(self) -> int:
        buttons = 0
        for sample in self._haptics.newest.values():
            buttons |= int(sample.data.buttons)
        return buttons


class DryRun:
    """The simulated observer in a participant's place."""

    def __init__(self, experiment: ExperimentFile, participant: int) -> None:
        self._observer = Simulated(experiment, participant)

    def answer(self, trial: Planned, condition: Condition, level: float, felt: Felt) -> str | float:
        return self._observer.answer(trial, condition, level)

    def pause(self, done: int, of: int) -> None:
        """Nobody needs one."""


def chosen(typed: str, buttons: int) -> str | None:
    """The choice that keys or newly pressed buttons say."""
    for key in typed:
        if key in KEYS:
            return KEYS[key]
    return CHOICES[0] if buttons & 1 else CHOICES[1] if buttons & 2 else None


def number(typed: str) -> float | None:
    """The number above 0 on the first whole line; None where there is none."""
    line, newline, _ = typed.partition("\n")
    try:
        value = float(line.replace(",", "."))
    except ValueError:
        return None
    return value if newline and 0.0 < value <= NUMBER_MAX else None


def said(line: str) -> None:
    """Tell the participant, whatever the log's level."""
    print(line, flush=True)


@contextmanager
def keyboard(single: bool) -> Iterator[Any]:
    """A function that returns what was typed since; key by key if `single` and standard input is a terminal."""
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
