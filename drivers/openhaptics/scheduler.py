"""The library's one thread, which all its devices in this process share.

The library takes devices before its thread is started, so a second one is opened while the thread stands still. That
may not be while a hand feels a force of the first: its motors keep what they were given.
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
"""How long a callback is waited for that is to come once more; the library may hang."""

_kept: Final[list[Block]] = []
"""Blocks of devices whose callback did not come any more: the library may yet call it, for as long as it is loaded."""


def within(seconds: float, met: Callable[[], Any]) -> bool:
    """Wait until something is so; False where it is not in that time."""
    until = time.monotonic() + seconds
    while not met():
        if time.monotonic() > until:
            return bool(met())
        time.sleep(POLL_S)
    return True


class Scheduler:
    """The thread of one loaded library: its devices, and the handles of what it calls for each."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._lock = threading.RLock()
        self._running = False
        self._called: dict[int, tuple[Block, int]] = {}
        """By the address of a block: the block, and the library's handle of its callback."""

    @contextmanager
    def still(self) -> Iterator[None]:
        """Inside, the library's thread does not run; behind, it runs again.

        Raises DeviceBusy where a device of this process is armed.
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
        """Have the thread call a device's callback from now on."""
        with self._lock:
            self._call(block)

    def remove(self, block: Block) -> None:
        """Have it called no more, and end the thread with the last device."""
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
        if not within(LEAVE_S, lambda: block.word[AT.left]):  # it takes itself out, unless it is not called any more
            _kept.append(block)
            self._library.hdUnschedule(handle)

    def _halt(self) -> None:
        if self._running:
            self._running = False
            self._library.hdStopScheduler()


_of: Final[dict[int, Scheduler]] = {}


def scheduler_of(library: ctypes.CDLL) -> Scheduler:
    """The scheduler of a library; two names of one file are one library."""
    return _of.setdefault(library._handle, Scheduler(library))
