"""Thread of the library, which all its devices in this process share.

The library accepts devices only before its thread starts, so the thread is stopped to open a second one. That is not
allowed while the first displays a force, because its motors keep the last command.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from softfinger.config.errors import DeviceBusy
from softfinger.drivers.block import Block
from softfinger.drivers.openhaptics import exchange
from softfinger.drivers.openhaptics.block import AT
from softfinger.drivers.openhaptics.library import PRIORITY_MAX

POLL_S: Final = 0.0002
LEAVE_S: Final = 0.2
"""Maximum wait for the last call of a callback; the library may hang."""

_unreleased: Final[list[Block]] = []
"""Blocks of devices whose callback was not called again: the library may call it as long as it is loaded."""


def wait_until(seconds: float, condition: Callable[[], Any]) -> bool:
    """Wait until `condition` returns a true value; return False after a timeout."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return bool(condition())
        time.sleep(POLL_S)
    return True


class Scheduler:
    """Thread of one loaded library: its devices, and the handles of their callbacks."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._lock = threading.RLock()
        self._running = False
        self._scheduled: dict[int, tuple[Block, int]] = {}
        """Blocks, and the library's handles of their callbacks, by the address of the block."""

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Stop the library's thread inside the context, and restart it afterwards.

        Raises DeviceBusy if a device of this process is armed.
        """
        with self._lock:
            for block, _ in self._scheduled.values():
                if block.word[AT.armed]:
                    raise DeviceBusy(
                        "another device of 3D Systems is in use by this program, and the library supports no second "
                        "one then: list both in one rig, so that they are opened together"
                    )
            scheduled_blocks = [block for block, _ in self._scheduled.values()]
            for block in scheduled_blocks:
                self._unschedule(block)
            self._stop_thread()
            opened = False
            try:
                yield
                opened = True
            finally:
                for block in scheduled_blocks:
                    self._schedule(block)
                if opened or scheduled_blocks:
                    self._library.hdStartScheduler()
                    self._running = True

    def add(self, block: Block) -> None:
        """Make the thread call a device's callback."""
        with self._lock:
            self._schedule(block)

    def remove(self, block: Block) -> None:
        """Stop calling a device's callback, and stop the thread with the last device."""
        with self._lock:
            if block.handle in self._scheduled:
                self._unschedule(block)
            if not self._scheduled:
                self._stop_thread()

    def _schedule(self, block: Block) -> None:
        block.word[AT.is_leaving] = block.word[AT.has_left] = 0
        handle = self._library.hdScheduleAsynchronous(exchange.run_frame.address, block.handle, PRIORITY_MAX)
        self._scheduled[block.handle] = block, handle

    def _unschedule(self, block: Block) -> None:
        _, handle = self._scheduled.pop(block.handle)
        block.word[AT.is_leaving] = 1
        if not wait_until(LEAVE_S, lambda: block.word[AT.has_left]):  # a callback that is still called removes itself
            _unreleased.append(block)
            self._library.hdUnschedule(handle)

    def _stop_thread(self) -> None:
        if self._running:
            self._running = False
            self._library.hdStopScheduler()


_schedulers: Final[dict[int, Scheduler]] = {}


def get_scheduler(library: ctypes.CDLL) -> Scheduler:
    """Return the scheduler of a library; the same for two names of one file."""
    return _schedulers.setdefault(library._handle, Scheduler(library))
