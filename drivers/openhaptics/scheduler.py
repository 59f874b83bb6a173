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

_kept: Final[list[Block]] = []
"""Blocks of devices whose callback was not called again: the library may call it as long as it is loaded."""


def within(seconds: float, met: Callable[[], Any]) -> bool:
    """Wait until `met` returns a true value; return False after a timeout."""
    until = time.monotonic() + seconds
    while not met():
        if time.monotonic() > until:
            return bool(met())
        time.sleep(POLL_S)
    return True


class Scheduler:
    """Thread of one loaded library: its devices, and the handles of their callbacks."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._lock = threading.RLock()
        self._running = False
        self._called: dict[int, tuple[Block, int]] = {}
        """Blocks, and the library's handles of their callbacks, by the address of the block."""

    @contextmanager
    def still(self) -> Iterator[None]:
        """Stop the library's thread inside the context, and restart it afterwards.

        Raises DeviceBusy if a device of this process is armed.
        """
        with self._lock:
            for block, _ in self._called.values():
                if block.word[AT.armed]:
                    raise DeviceBusy(
                        "another device of 3D Systems is in use by this program, and the library takes no second one "
                        "then: name both in one rig, so that they are opened together"
                    )
            others = [block for block, _ in self._called.values()]
            for block in others:
                self._take_out(block)
            self._halt()
            opened = False
            try:
                yield
                opened = True
            finally:
                for block in others:
                    self._call(block)
                if opened or others:
                    self._library.hdStartScheduler()
                    self._running = True

    def add(self, block: Block) -> None:
        """Make the thread call a device's callback."""
        with self._lock:
            self._call(block)

    def remove(self, block: Block) -> None:
        """Stop calling a device's callback, and stop the thread with the last device."""
        with self._lock:
            if block.handle in self._called:
                self._take_out(block)
            if not self._called:
                self._halt()

    def _call(self, block: Block) -> None:
        block.word[AT.leave] = block.word[AT.left] = 0
        handle = self._library.hdScheduleAsynchronous(exchange.callback.address, block.handle, PRIORITY_MAX)
        self._called[block.handle] = block, handle

    def _take_out(self, block: Block) -> None:
        _, handle = self._called.pop(block.handle)
        block.word[AT.leave] = 1
        if not within(LEAVE_S, lambda: block.word[AT.left]):  # a callback that is still called removes itself
            _kept.append(block)
            self._library.hdUnschedule(handle)

    def _halt(self) -> None:
        if self._running:
            self._running = False
            self._library.hdStopScheduler()


_of: Final[dict[int, Scheduler]] = {}


def scheduler_of(library: ctypes.CDLL) -> Scheduler:
    """Return the scheduler of a library; the same for two names of one file."""
    return _of.setdefault(library._handle, Scheduler(library))
