"""Source of answers: a participant at the device, who types in the terminal or presses the buttons of the device."""

from __future__ import annotations

import codecs
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Final

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.server.experiment.haptics import Haptics
from softfinger.server.experiment.interfaces import Progress, Response, TouchResult
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.schema_parts import Question
from softfinger.server.experiment.session import is_right_answer
from softfinger.server.experiment.trial_order import Condition, PlannedTrial, choose_by_condition
from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import TEXT_ANSWER_MAX, Prompt

CHOICES: Final = ("first", "second")
KEYS: Final = {"1": "first", "2": "second"}


def is_single(prompt: Prompt) -> bool:
    """Return True if a single key answers the prompt."""
    return len(prompt.choices) == 1 or prompt.choices == CHOICES


def parse_answer(prompt: Prompt, typed: str, buttons: int) -> tuple[str | float | None, str]:
    """Return the answer from the typed text and newly pressed buttons, or None, and the unused text.

    With one choice, any key or button answers. With CHOICES, the keys 1 and 2 and the first two buttons do. All other
    prompts require a line.
    """
    choices = prompt.choices
    if len(choices) == 1:
        return (choices[0] if typed or buttons else None), ""
    if choices == CHOICES:
        keys = [KEYS[key] for key in typed if key in KEYS]
        return (keys[0] if keys else CHOICES[0] if buttons & 1 else CHOICES[1] if buttons & 2 else None), ""
    line, newline, remaining = typed.partition("\n")
    if not newline or not line.strip():
        return None, remaining if newline else line
    if prompt.text_length:
        return line.strip()[: prompt.text_length], remaining
    return (line.strip()[:64] if choices else parse_number(line)), remaining


def print_line(line: str) -> None:
    """Print a line for the participant, independent of the log level."""
    print(line, flush=True)


@contextmanager
def read_keyboard(single: bool) -> Iterator[Callable[[], str]]:
    """Yield a function that returns the text typed since its last call.

    A terminal passes it on key by key if `single`, otherwise line by line.
    """
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor) if single and sys.stdin.isatty() else None
    is_at_end, decoder = False, codecs.getincrementaldecoder("utf-8")("replace")

    def keys() -> str:
        nonlocal is_at_end
        if is_at_end or not select.select([descriptor], [], [], 0.0)[0]:
            return ""
        data = os.read(descriptor, 256)
        is_at_end = not data
        return decoder.decode(data)  # a character may be cut by the end of a block

    try:
        if before is not None:
            tty.setcbreak(descriptor)
        yield keys
    finally:
        if before is not None:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


NUMBERS: Final = (1e-6, 1e6)
"""Range of an estimate, which is a number above 0."""
CONTINUE: Final = "go on"
BEGIN: Final = "begin"
END: Final = "That was the last trial. Thank you."
POLL_S: Final = 0.1
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
        self._title, self._prompt = "", partial(Prompt)
        """Title of the present trial, and its prompt without text and question."""
        self._last_key_s = 0.0

    def instruct(self) -> None:
        """Show the instructions until the participant starts."""
        if text := self._experiment.instructions:
            self._ask(
                Prompt(self._experiment.title, text, choices=(BEGIN,)), f"{text} Press Enter or a button to start."
            )

    def prepare(self, progress: Progress, condition: Condition) -> None:
        screen, task = choose_by_condition(self._experiment.screen, condition), self._experiment.task
        self._title = progress.title
        self._prompt = partial(
            Prompt, progress.title, done=progress.trial - 1, of=progress.trials, colour=screen.colour,
            image=self._images.get(screen.image, ""), masking_noise=screen.masking_noise, volume=screen.volume,
        )  # fmt: skip
        self._show(self._prompt(text=task.question if task.kind == "trace" else progress.text))

    def answer(self, trial: PlannedTrial, condition: Condition, level: float, result: TouchResult) -> Response:
        task = self._experiment.task
        if task.kind == "trace":
            return Response(float(result.summary.get("duration_s", 0.0)))
        if task.kind == "compare":
            prompt = self._prompt(text=task.question, choices=CHOICES)
            answer = self._ask(prompt, f"{task.question} 1: the first, 2: the second")
            if trial.practice:
                text = "That was right." if is_right_answer(trial, answer.value) else "That was wrong."
                self._ask(self._prompt(text=text, choices=(CONTINUE,)), f"{text} Press Enter or a button to continue.")
            return answer
        if task.scale is None:
            prompt = self._prompt(text=task.question, number=NUMBERS)
            return self._ask(prompt, f"{task.question} A number above 0, then Enter")
        ends = ", ".join(f"{mark}: {word}" for mark, word in zip(task.scale, task.scale_ends, strict=False))
        prompt = self._prompt(text=f"{task.question}\n{ends}", choices=task.marks)
        answer = self._ask(prompt, f"{task.question} {ends} ({task.scale[0]} to {task.scale[1]}, then Enter)")
        return answer._replace(value=float(answer.value))

    def confidence(self, trial: PlannedTrial, condition: Condition, level: float, question: Question) -> Response:
        return self.ask(self._title, question, condition, trial.number, (0, 0))

    def ask(
        self, title: str, question: Question, condition: Condition | None, number: int, place: tuple[int, int]
    ) -> Response:
        line, (index, total) = question.text, place
        if total > 1:
            title = f"{title}: question {index + 1} of {total}"
        prompt = partial(Prompt, title, line, *place if total > 1 else (0, 0))
        if question.kind == "text":
            return self._ask(prompt(text_length=TEXT_ANSWER_MAX), f"{line} A text, then Enter")
        if question.kind == "number":
            limits = question.min, question.max
            return self._ask(prompt(number=limits), f"{line} A number from {limits[0]:g} to {limits[1]:g}, then Enter")
        choices = question.marks if question.kind == "likert" else question.options
        answer = self._ask(prompt(choices=choices), f"{line} One of {', '.join(choices)}, then Enter")
        return answer._replace(value=float(answer.value)) if question.kind == "likert" else answer

    def pause(self, completed: int, total: int) -> None:
        progress_text = f"{completed} of {total} trials are done."
        prompt = Prompt("A break", f"{progress_text} Continue when you are ready.", completed, total, (CONTINUE,))
        self._ask(prompt, f"{progress_text} A break: Press Enter or a button to continue.")

    def end(self) -> None:
        """Show the debriefing until the participant has read it, and then that the session is over."""
        if text := self._experiment.debriefing:
            self._ask(
                Prompt(self._experiment.title, text, choices=(CONTINUE,)),
                f"{text} Press Enter or a button to continue.",
            )
        self._show(Prompt(self._experiment.title, END))

    def _show(self, prompt: Prompt) -> int:
        number: int = self._haptics.client.ask("set_prompt", prompt).number
        return number

    def _ask(self, prompt: Prompt, line: str) -> Response:
        client, typed, single = self._haptics.client, "", is_single(prompt)
        with read_keyboard(single) as keys:  # discards keys typed before the question
            if single and sys.stdin.isatty():
                self._wait_for_release(keys)
            number, held_buttons = self._show(prompt), self._read_buttons()
            print_line(line)
            while (prompted := client.get_prompt()).open and prompted.number == number:
                self._haptics.wait(POLL_S)
                typed += keys()
                buttons = self._read_buttons()
                value, typed = parse_answer(prompt, typed, buttons & ~held_buttons)
                held_buttons &= buttons  # a button that is already down must be released first
                if value is not None:
                    self._last_key_s = time.monotonic()
                    self._send_answer(value, number)
        if prompted.number != number or prompted.answer is None:
            raise ConfigError("another program has replaced the question by its own prompt: end it first")
        return Response(prompted.answer, prompted.after_s)

    def _wait_for_release(self, keys: Callable[[], str]) -> None:
        """Wait until no key of the terminal is pressed: a repeating key would answer every question."""
        is_informed = False
        while True:
            self._haptics.wait(POLL_S)
            if keys():
                self._last_key_s = time.monotonic()
                if not is_informed:
                    print_line(RELEASE)
                is_informed = True
            elif time.monotonic() - self._last_key_s > RELEASE_S:
                return

    def _send_answer(self, value: str | float, number: int) -> None:
        try:
            self._haptics.client.answer(value, number)
        except CommandRefused as refused:
            print_line(str(refused))

    def _read_buttons(self) -> int:
        buttons = 0
        for sample in self._haptics.latest.values():
            buttons |= int(sample.data.buttons)
        return buttons
