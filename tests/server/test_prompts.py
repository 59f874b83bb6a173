"""Prompt of an experiment on a daemon: shown on request, answered once, refused with one error."""

from __future__ import annotations

import time
from typing import Any

import pytest
from helpers.pages import daemon_of

from softfinger.config.errors import CommandRefused
from softfinger.server.remote import Client
from softfinger.server.wire.client import Subscription
from softfinger.server.wire.commands import Prompt, PromptScreen
from softfinger.server.wire.protocol import EVENT

pytestmark = pytest.mark.real_time

WAIT_S = 60.0


daemon = daemon_of("simulated-hand", "paper-plane")


def subscribe_events(client: Client) -> tuple[Subscription, list[dict[str, Any]]]:
    events = client.subscribe((EVENT,), timeout_s=WAIT_S)
    received: list[dict[str, Any]] = []
    until = time.monotonic() + WAIT_S
    while not received and time.monotonic() < until:
        client.mark("begin")
        if (sample := events.receive(0.1)) is not None:
            received.append(sample.data)
    return events, received


def test_a_question_is_shown_and_answered_once(client: Client) -> None:
    events, received = subscribe_events(client)
    screen = {"colour": "#3366cc", "image": "data:image/png;base64,AAAA", "masking_noise": "pink", "volume": 0.5}
    question = client.set_prompt("trial 3", "Which?", (2, 40), choices=("first", "second"), **screen)
    assert client.get_prompt() == question and question.open and question.answer is None
    assert question.prompt == Prompt("trial 3", "Which?", 2, 40, ("first", "second"), **screen)
    assert PromptScreen.__annotations__.keys() == screen.keys() and Prompt.__struct_fields__[-4:] == tuple(screen)
    client.answer("second", question.number)
    answered = client.get_prompt()
    assert not answered.open and answered.answer == "second" and 0.0 < answered.after_s < WAIT_S
    with pytest.raises(CommandRefused, match="not open, or not any more"):
        client.answer("first", question.number)
    while received[-1]["name"] != "answer":
        received.append(next(events).data)
    assert [event["name"] for event in received if event["kind"] == "command"] == ["set_prompt", "answer"]
    assert received[-1]["what"] == {"prompt": question.number, "value": "second"}


def test_an_answer_to_an_earlier_question_is_refused(client: Client) -> None:
    """A page that is late may send one."""
    before = client.set_prompt(choices=("a", "b")).number
    client.set_prompt(choices=("a", "b"))
    with pytest.raises(CommandRefused, match="answer the one that is shown"):
        client.answer("a", before)


@pytest.mark.parametrize(
    "value", ["neither", "", 1.0, True, None, ["first"], {"first": 1}, "x" * 100_000, float("nan")]
)
def test_an_answer_that_is_not_a_choice_is_refused(client: Client, value: Any) -> None:
    question = client.set_prompt(choices=("first", "second"))
    with pytest.raises(CommandRefused, match="bad_params"):
        client.ask("answer", {"value": value, "prompt": question.number})
    assert client.get_prompt().open


def test_a_text_answer_is_stored_and_not_published(client: Client) -> None:
    """Its length is limited and it is not in the event, because a text in a recording may be personal."""
    events, received = subscribe_events(client)
    question = client.set_prompt("remarks", "Any?", text_length=12)
    assert question.prompt == Prompt("remarks", "Any?", text_length=12)
    for value in ("", "   ", "x" * 13, 1.0):
        with pytest.raises(CommandRefused, match="bad_params"):
            client.ask("answer", {"value": value})
    client.answer("<b>none</b>", question.number)
    assert client.get_prompt().answer == "<b>none</b>"
    while received[-1]["name"] != "answer":
        received.append(next(events).data)
    assert received[-1]["what"] == {"prompt": question.number}


@pytest.mark.parametrize("value", [0.5, 7.01, float("nan"), float("inf"), -float("inf"), "3", True])
def test_a_number_outside_the_range_is_refused(client: Client, value: Any) -> None:
    client.set_prompt(number=(1.0, 7.0))
    with pytest.raises(CommandRefused, match="bad_params"):
        client.ask("answer", {"value": value})
    client.answer(7.0)


@pytest.mark.parametrize(
    ("prompt", "message"),
    [
        ({"choices": ["a"], "number": [0.0, 1.0]}, "either choices or number"),
        ({"choices": ["a"], "text_length": 9}, "either choices or number or text_length"),
        ({"colour": "red"}, "colour"),
        ({"image": "https://example.org/a.png"}, "image"),
        ({"image": "data:image/svg+xml;base64,AAAA"}, "image"),
        ({"masking_noise": "brown"}, "masking_noise"),
        ({"number": [1.0, 1.0]}, "must be the smallest, then the largest"),
        ({"number": [0.0, float("nan")]}, "must be the smallest, then the largest"),
        ({"choices": [""]}, "choices"),
        ({"choices": ["a"] * 22}, "choices"),
        ({"text": "x" * 5000}, "text"),
        ({"html": "<script>"}, "html"),
    ],
)
def test_an_invalid_prompt_is_refused(client: Client, prompt: dict[str, Any], message: str) -> None:
    before = client.get_prompt()
    with pytest.raises(CommandRefused, match=message):
        client.ask("set_prompt", prompt)
    assert client.get_prompt() == before
