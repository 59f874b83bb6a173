"""The devices that this process has open: what a signal zeroes and closes, whoever opened them.

Imports nothing: signals are handled before the rest of the program is there.
"""

from __future__ import annotations

import weakref
from typing import Final, Protocol


class Stoppable(Protocol):
    """A device (drivers.base.Device), as far as it matters here."""

    def stop(self) -> None: ...
    def close(self) -> None: ...


devices: Final[weakref.WeakSet[Stoppable]] = weakref.WeakSet()
"""Until nobody holds a device any more, it can be stopped and closed any number of times."""


def stop_all() -> list[BaseException]:
    """Stop every one of them, whatever becomes of the one before; returns what those said that could not be."""
    failures: list[BaseException] = []
    for device in list(devices):
        try:
            device.stop()
        except BaseException as error:
            failures.append(error)
    return failures
