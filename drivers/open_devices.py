"""Open devices of this process, which a signal handler zeroes and closes.

Imports nothing else of the program, because signals are handled before other modules are loaded.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Final, Protocol, TypeVar

STOP_TIMEOUT_S: Final = 2.0
"""Time for a device to stop or close. A slower one hangs: the shutdown continues without it."""


class Stoppable(Protocol):
    """Device (drivers.base.Device), reduced to the methods used here."""

    def stop(self) -> None: ...
    def close(self) -> None: ...


Target = TypeVar("Target", bound=Stoppable)

devices: Final[weakref.WeakSet[Stoppable]] = weakref.WeakSet()
"""While a device is referenced, it can be stopped and closed any number of times."""


def call_all(call: Callable[[Target], None], targets: Sequence[Target]) -> list[tuple[Target, BaseException]]:
    """Call `call` with all devices in parallel, so that a failing or hanging device delays no other.

    Returns
    -------
    list
        Failed devices with their errors: TimeoutError for a call that did not return within STOP_TIMEOUT_S; it
        continues in its thread.
    """
    failures: dict[int, BaseException] = {}

    def run(index: int) -> None:
        try:
            call(targets[index])
        except BaseException as error:
            failures[index] = error

    threads = [threading.Thread(target=run, args=(index,), daemon=True) for index in range(len(targets))]
    for thread in threads:
        thread.start()
    until = time.monotonic() + STOP_TIMEOUT_S
    for index, thread in enumerate(threads):
        thread.join(max(until - time.monotonic(), 0.0))
        if thread.is_alive():
            failures[index] = TimeoutError(f"the call has not returned for {STOP_TIMEOUT_S:g} s")
    return [(targets[index], failures[index]) for index in sorted(failures)]


def stop_all() -> list[BaseException]:
    """Stop every open device, despite failures; return the errors."""
    return [error for _, error in call_all(lambda device: device.stop(), list(devices))]


def close_all() -> None:
    """Close every open device, despite failures."""
    call_all(lambda device: device.close(), list(devices))
