"""How long Python threads may keep the interpreter from each other while a device is open.

An exchange with the service gives up the interpreter's lock with each system call, and a busy thread hands it back
after the switch interval: 5 ms by default, several times in an exchange.
"""

from __future__ import annotations

import sys
import threading
from typing import Final

SWITCH_S: Final = 2e-4
"""Switch interval while a device is open."""

_lock: Final = threading.Lock()
_before: Final[list[float]] = []
"""The interval that was found, once for each open device."""


def shorten() -> None:
    """For one more device."""
    with _lock:
        _before.append(sys.getswitchinterval())
        sys.setswitchinterval(min(_before[0], SWITCH_S))


def restore() -> None:
    """For one device less; the last one puts back what the first one found."""
    with _lock:
        found = _before.pop()
        if not _before:
            sys.setswitchinterval(found)
