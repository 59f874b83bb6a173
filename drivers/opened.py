"""Open devices of this process, which a signal handler zeroes and closes.

Imports nothing else of the program, because signals are handled before other modules are loaded.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Final, Protocol, TypeVar

END_S: Final = 2.0
"""Time for a device to stop or close. A slower one hangs: the shutdown continues without it."""


class Stoppable(Protocol):
    """Device (drivers.base.Device), reduced to the methods used here."""

    def stop(self) -> None: ...
    def close(self) -> None: ...


Each = TypeVar("Each", bound=Stoppable)

devices: Final[weakref.WeakSet[Stoppable]] = weakref.WeakSet()
"""While a device is referenced, it can be stopped and closed any number of times."""


def at_once(act: Callable[[Each], None], some: Sequence[Each]) -> list[tuple[Each, BaseException]]:
    """Call `act` for all devices in parallel, so that a failing or hanging device delays no other.

    Returns
    -------
    list
        Failed devices with their errors: TimeoutError for a call that did not return within END_S; it continues in its
        thread.
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
    """Stop every open device, despite failures; return the errors."""
    return [error for _, error in at_once(lambda device: device.stop(), list(devices))]


def close_all() -> None:
    """Close every open device, despite failures."""
    at_once(lambda device: device.close(), list(devices))
