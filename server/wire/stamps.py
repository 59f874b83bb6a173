"""Timestamps of messages, events and recordings: the time of day at the start, plus CLOCK_MONOTONIC since then.

Ticks use the same clock, so a clock that is set while the daemon runs changes no order. Suspensions of the machine are
not included.
"""

from __future__ import annotations

import time
from typing import Final

_START_S: Final = time.time() - time.monotonic()


def read_clock_s() -> float:
    return _START_S + time.monotonic()
