"""Prompts that pages show to the participant of an experiment, and the single answer to each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from msgspec import structs

from softfinger.config.words import format_value
from softfinger.server.wire import commands as wire
from softfinger.server.wire.envelope import DeclinedRequest, Request


class Prompts:
    """Current prompt, and whether it is open for an answer.

    publish  publishes a change made by a command: method, id of the request, change
    ticks    returns the number of ticks started
    """

    def __init__(self, publish: Callable[[str, str, Mapping[str, Any]], None], ticks: Callable[[], int]) -> None:
        self._publish, self._ticks = publish, ticks
        self._current = wire.PromptResult(0, wire.Prompt(), open=False)
        self._shown_s = 0.0

    def get(self, request: Request) -> wire.PromptResult:
        return self._current

    def set(self, request: Request) -> wire.PromptResult:
        prompt: wire.Prompt = request.params
        if bool(prompt.choices) + (prompt.number is not None) + bool(prompt.text_length) > 1:
            raise DeclinedRequest("bad_params", "set either choices, number or text_length: a prompt has one answer")
        if prompt.number is not None and not prompt.number[0] < prompt.number[1]:
            raise DeclinedRequest(
                "bad_params", f"number is {list(prompt.number)}: must be the smallest, then the largest"
            )
        is_open = bool(prompt.choices) or prompt.number is not None or prompt.text_length > 0
        self._current, self._shown_s = wire.PromptResult(self._current.number + 1, prompt, is_open), time.monotonic()
        self._publish("set_prompt", request.command_id, {"prompt": self._current.number})
        return self._current

    def answer(self, request: Request) -> wire.AppliedResult:
        """Store the answer; raises DeclinedRequest if no question is open or the answer is not valid."""
        params: wire.Answer = request.params
        if not self._current.open or params.prompt not in (None, self._current.number):
            raise DeclinedRequest("refused", "this question is not open: answer the one that is shown")
        if (expected := self._describe_expected_answer(params.value)) is not None:
            raise DeclinedRequest("bad_params", f"value is {format_value(params.value)}: give {expected}")
        after_s = time.monotonic() - self._shown_s
        self._current = structs.replace(self._current, open=False, answer=params.value, after_s=after_s)
        # A free text may be personal: it is neither published nor recorded.
        value = {} if self._current.prompt.text_length else {"value": params.value}
        self._publish("answer", request.command_id, {"prompt": self._current.number} | value)
        return wire.AppliedResult(self._ticks())

    def _describe_expected_answer(self, value: str | float) -> str | None:
        """Return a description of the valid answers, None if the value is valid."""
        now = self._current.prompt
        if now.text_length:
            is_valid = isinstance(value, str) and len(value.strip()) > 0 and len(value) <= now.text_length
            return None if is_valid else f"a text of at most {now.text_length} characters"
        if now.number is None:
            return None if value in now.choices else f"one of {', '.join(now.choices)}"
        low, high = now.number
        is_valid = isinstance(value, int | float) and low <= value <= high  # false for NaN
        return None if is_valid else f"a number from {low:g} to {high:g}"
