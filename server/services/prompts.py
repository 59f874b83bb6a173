"""Prompts that pages show to the participant of an experiment, and the single answer to each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from msgspec import structs

from softfinger.config.words import shown
from softfinger.server.wire import commands as wire
from softfinger.server.wire.envelope import Declined, Request


class Prompts:
    """Current prompt, and whether it is open for an answer.

    tell   publishes a change made by a command: method, id of the request, change
    ticks  returns the number of ticks started
    """

    def __init__(self, tell: Callable[[str, str, Mapping[str, Any]], None], ticks: Callable[[], int]) -> None:
        self._tell, self._ticks = tell, ticks
        self._now = wire.Prompted(0, wire.Prompt(), open=False)
        self._asked_s = 0.0

    def get(self, request: Request) -> wire.Prompted:
        """Return the current prompt."""
        return self._now

    def set(self, request: Request) -> wire.Prompted:
        """Replace the current prompt."""
        asked: wire.Prompt = request.params
        if asked.choices and asked.number is not None:
            raise Declined("bad_params", "say either choices or number: there is one answer")
        if asked.number is not None and not asked.number[0] < asked.number[1]:
            raise Declined("bad_params", f"number is {list(asked.number)}: give the smallest, then the largest")
        asks = bool(asked.choices) or asked.number is not None
        self._now, self._asked_s = wire.Prompted(self._now.number + 1, asked, asks), time.monotonic()
        self._tell("set_prompt", request.command_id, {"prompt": self._now.number})
        return self._now

    def answer(self, request: Request) -> wire.Applied:
        """Store the answer; raises Declined if no question is open or the answer is not valid."""
        given: wire.Answer = request.params
        if not self._now.open or given.prompt not in (None, self._now.number):
            raise Declined("refused", "this question is not open, or not any more: answer the one that is shown")
        if (wanted := self._wanted(given.value)) is not None:
            raise Declined("bad_params", f"value is {shown(given.value)}: give {wanted}")
        after_s = time.monotonic() - self._asked_s
        self._now = structs.replace(self._now, open=False, answer=given.value, after_s=after_s)
        self._tell("answer", request.command_id, {"prompt": self._now.number, "value": given.value})
        return wire.Applied(self._ticks())

    def _wanted(self, value: str | float) -> str | None:
        """Return a description of the valid answers, None if the value is valid."""
        now = self._now.prompt
        if now.number is None:
            return None if value in now.choices else f"one of {', '.join(now.choices)}"
        low, high = now.number
        there = isinstance(value, int | float) and low <= value <= high  # false for NaN
        return None if there else f"a number from {low:g} to {high:g}"
