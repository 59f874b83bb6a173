"""Requests that turn the force off: the publisher makes the loop do so before the daemon has read them.

Both processes count these requests, and the force is off while the counts differ (`loop/force_switch.py`).
"""

from __future__ import annotations

import mmap
import os
from typing import Final

import msgspec

from softfinger.server.loop.switch_fields import STOPS_RECEIVED, UNREACHABLE_NS

FORCE_OFF_METHODS: Final = ("disarm", "stop")
SHORT_REQUEST_BYTES: Final = 4096
"""Longest such request in bytes; longer requests are not decoded."""


class _MethodName(msgspec.Struct):
    method: str


_decoder: Final = msgspec.msgpack.Decoder(_MethodName)


def takes_force_off(body: bytes) -> bool:
    """Return whether an encoded request turns the force off."""
    if len(body) > SHORT_REQUEST_BYTES or not (b"disarm" in body or b"stop" in body):
        return False
    try:
        return _decoder.decode(body).method in FORCE_OFF_METHODS
    except (msgspec.DecodeError, ValueError, RecursionError):
        return False


class ForceOffCounter:
    """The publisher's side of the force switch; takes ownership of its file."""

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, 0)
        os.close(file)
        self._words = memoryview(self._memory).cast("q")

    def count(self, requests: int) -> None:
        self._words[STOPS_RECEIVED] += requests

    def reset_time(self) -> None:
        """Report that this process reads requests; without it the loop turns the force off (`UNREACHABLE_MAX_S`)."""
        self._words[UNREACHABLE_NS] = 0
