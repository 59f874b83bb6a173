"""The devices that this process has open: what a signal zeroes and closes, whoever opened them.

Imports nothing of the program: signals are handled before the rest of it is there.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Final, Protocol, TypeVar

END_S: Final = 2.0
"""How long a device may take to stop or to close. One that takes longer hangs: the shutdown goes on without it."""


class Stoppable(Protocol):
    """A device (drivers.base.Device), as far as it matters here."""

    def stop(self) -> None: ...
    def close(self) -> None: ...


Each = TypeVar("Each", bound=Stoppable)

devices: Final[weakref.WeakSet[Stoppable]] = weakref.WeakSet()
"""Until nobody holds a device any more, it can be stopped and closed any number of times."""


def at_once(act: Callable[[Each], None], some: Sequence[Each]) -> list[tuple[Each, BaseException]]:
    """Do something to each at the same time: one that fails or hangs keeps no other from its turn.

    Returns those that failed, and how: TimeoutError for one that has not ended after END_S, and goes on in its thread.
    """
    failures: dict[int, BaseException] = {}

    def run(place: int) -> None:
        try:
            act(some[place])
        except BaseException as error:
            failures[place] = error

    threads = [threading.Thread(target=run, args=(place,), daemon=True) for place in range(len(some))]
    for thread in threads:
        thread.start()
    until = time.monotonic() + END_S
    for place, thread in enumerate(threads):
        thread.join(max(until - time.monotonic(), 0.0))
        if thread.is_alive():
            failures[place] = TimeoutError(f"it has not come back for {END_S:g} s")
    return [(some[place], failures[place]) for place in sorted(failures)]


def stop_all() -> list[BaseException]:
    """Stop every one of them, whatever becomes of the others; returns what those said that could not be."""
    return [error for _, error in at_once(lambda device: device.stop(), list(devices))]


def close_all() -> None:
    """Close every one of them, whatever becomes of the others."""
    at_once(lambda device: device.close(), list(devices))
