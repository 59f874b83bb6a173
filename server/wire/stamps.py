"""The time that messages, events and recordings carry: the time of day at the start, and CLOCK_MONOTONIC since then.

Ticks go by the same, so a clock that is set while the daemon runs puts nothing out of order. The time that a machine
sleeps is not in it.
"""

from __future__ import annotations

import time
from typing import Final

_START_S: Final = time.time() - time.monotonic()


def now_s() -> float:
    """Seconds since the epoch."""
    return _START_S + time.monotonic()
