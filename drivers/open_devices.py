"""Open devices of this process, which a signal handler zeroes and closes.

Imports nothing else of the program, because signals are handled before other modules are loaded.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
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
_hung: Final[weakref.WeakSet[Stoppable]] = weakref.WeakSet()
"""Devices of which a call has not returned in time."""
RESERVED_THREADS: Final = 16
"""For each of up to eight devices a thread for a call, and another one for a library that may hang in it."""
_reserved: Final[list[SimpleQueue[Callable[[], None]]]] = []
"""Queue of each reserved thread that is idle."""


def reserve_threads() -> None:
    """Start threads for `call_all` before a device is opened, because the system may have none left later.

    Raises RuntimeError if it has none left now.
    """
    while len(_reserved) < RESERVED_THREADS:
        calls = SimpleQueue[Callable[[], None]]()
        threading.Thread(target=_run_calls, args=(calls,), name="reserved", daemon=True).start()
        _reserved.append(calls)


def _run_calls(calls: SimpleQueue[Callable[[], None]]) -> None:
    while True:
        calls.get()()
        _reserved.append(calls)


def _start(call: Callable[[], None]) -> bool:
    """Run `call`, which raises no error, in another thread; return False if there is none."""
    try:
        threading.Thread(target=call, daemon=True).start()
    except RuntimeError:
        try:
            _reserved.pop().put(call)
        except IndexError:
            return False
    return True


def call_all(
    call: Callable[[Target], object], targets: Sequence[Target], timeout_s: float | None = None
) -> list[tuple[Target, BaseException]]:
    """Call `call` with all devices in parallel, so that a failing or hanging device delays no other.

    If the system has no thread left, reserved threads are used. If none of them is idle, this thread calls the
    remaining devices, one after the other, without those that have hung before.

    Parameters
    ----------
    timeout_s
        Time for all calls, s; None: STOP_TIMEOUT_S.

    Returns
    -------
    list
        Failed devices with their errors: TimeoutError for a call that did not return in time; it continues in its
        thread.
    """
    timeout_s = STOP_TIMEOUT_S if timeout_s is None else timeout_s
    finished = [threading.Event() for _ in targets]
    failures: dict[int, BaseException] = {}

    def run(index: int) -> None:
        try:
            call(targets[index])
        except BaseException as error:
            failures[index] = error
        finally:
            finished[index].set()

    for index in [index for index in range(len(targets)) if not _start(partial(run, index))]:
        if targets[index] not in _hung:
            run(index)
    until = time.monotonic() + timeout_s
    for index, target in enumerate(targets):
        if not finished[index].wait(max(until - time.monotonic(), 0.0)):
            failures[index] = TimeoutError(f"the call has not returned for {timeout_s:g} s")
            _hung.add(target)
    return [(targets[index], failures[index]) for index in sorted(failures)]


def stop_all() -> list[BaseException]:
    """Stop every open device, despite failures; return the errors."""
    return [error for _, error in call_all(lambda device: device.stop(), list(devices))]


def close_all() -> None:
    """Close every open device, despite failures."""
    call_all(lambda device: device.close(), list(devices))
