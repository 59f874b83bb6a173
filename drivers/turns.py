"""How long Python threads may keep the interpreter from each other while some thread has to be prompt.

An exchange with a device's service, or a command, gives up the interpreter's lock with each system call. A busy thread
hands it back after the switch interval: 5 ms by default, several times in an exchange.
"""

from __future__ import annotations

import sys
import threading
from typing import Final

SWITCH_S: Final = 2e-4
"""Switch interval while anybody has asked for it."""

_lock: Final = threading.Lock()
_before: Final[list[float]] = []
"""The interval that was found, once for each who asked."""


def shorten() -> None:
    """Shorten the switch interval until `restore`; calls may be nested."""
    with _lock:
        _before.append(sys.getswitchinterval())
        sys.setswitchinterval(min(_before[0], SWITCH_S))


def restore() -> None:
    """Undo one `shorten`; the last one restores the interval that the first one found."""
    with _lock:
        found = _before.pop()
        if not _before:
            sys.setswitchinterval(found)
