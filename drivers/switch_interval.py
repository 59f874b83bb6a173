"""Switch interval of Python threads, shortened while a thread has to respond quickly.

An exchange with a device's service, or a command, releases the interpreter lock with each system call. A busy thread
returns it after the switch interval: 5 ms by default, several times in one exchange.
"""

from __future__ import annotations

import sys
import threading
from typing import Final

SHORT_INTERVAL_S: Final = 2e-4
"""Switch interval while at least one caller has shortened it."""

_lock: Final = threading.Lock()
_previous_intervals: Final[list[float]] = []
"""Interval found by each `shorten` that is still in effect."""


def shorten() -> None:
    """Shorten the switch interval until `restore`; calls may be nested."""
    with _lock:
        _previous_intervals.append(sys.getswitchinterval())
        sys.setswitchinterval(min(_previous_intervals[0], SHORT_INTERVAL_S))


def restore() -> None:
    """Undo one `shorten`. The last call restores the interval from before the first `shorten`."""
    with _lock:
        previous = _previous_intervals.pop()
        if not _previous_intervals:
            sys.setswitchinterval(previous)
