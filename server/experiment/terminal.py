"""Answers typed in the terminal, or given by the buttons of a device."""

from __future__ import annotations

import codecs
import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import Prompt

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
