"""Answers typed in a terminal: unusual texts, decimal commas, characters split between two reads."""

from __future__ import annotations

import os
from typing import Any

import pytest
from test_trial_order import make_tables

from softfinger.server.experiment.answers import CHOICES, parse_answer, read_keyboard
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.observer import SimulatedObserver
from softfinger.server.wire.commands import Prompt

pytestmark = pytest.mark.plain

NUMBER = Prompt("t", "?", number=(0.5, 2.5))
TEXT = Prompt("t", "?", text_length=5)


@pytest.mark.parametrize(
    ("prompt", "typed", "answer", "rest"),
    [
        (NUMBER, "1,75\n", 1.75, ""),
        (NUMBER, " 1.75 \n2", 1.75, "2"),
        (NUMBER, "1.000,5\n", "1.000,5", ""),  # not a number: the daemon refuses it
        (NUMBER, "1.7", None, "1.7"),
        (NUMBER, "\n", None, ""),
        (TEXT, "größer\n", "größe", ""),
        (TEXT, "  \n", None, ""),
        (Prompt("t", "?", choices=CHOICES), "x2", "second", ""),
        (Prompt("t", "?", choices=("a b", "c")), "a b\n", "a b", ""),
    ],
)
def test_a_line_is_an_answer(prompt: Prompt, typed: str, answer: Any, rest: str) -> None:
    assert parse_answer(prompt, typed, 0) == (answer, rest)


def test_a_character_split_between_two_reads_is_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read returns at most 256 bytes, which splits an ü."""
    text = "a" + 300 * "ü" + "\n"
    reader, writer = os.pipe()
    with os.fdopen(reader) as stdin, os.fdopen(writer, "w") as typed, open_keyboard(stdin, monkeypatch) as keys:
        typed.write(text)
        typed.flush()
        assert "".join(keys() for _ in range(4)) == text


def open_keyboard(stdin: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("sys.stdin", stdin)
    return read_keyboard(single=False)


def test_simulated_numbers_are_within_their_bounds() -> None:
    height = {"name": "height", "kind": "number", "prompt": "?", "min": 0.5, "max": 2.5}
    survey = {"name": "s", "at": ["before"], "question": [height]}
    for changes, expected in (({}, {1.0, 2.0}), ({"observer": {"answers": {"height": 0.5}}}, {0.5, 1.0})):
        file = Experiment(make_tables(survey=[survey], **changes)).file
        (question,) = file.survey[0].question
        assert {SimulatedObserver(file, 1).survey(question, None, number) for number in range(200)} == expected
