"""Far end of a pseudo terminal, for boards emulated by a thread in Python."""

from __future__ import annotations

import os
import threading
import tty
from contextlib import suppress
from typing import Self


class FarTerminal:
    def __init__(self, period_s: float) -> None:
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.path = os.ttyname(self._near)
        self._period_s = period_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def turn(self) -> None:
        raise NotImplementedError

    def read(self) -> bytes:
        """Return the bytes received since the last call."""
        with suppress(BlockingIOError):
            return os.read(self._far, 4096)
        return b""

    def write(self, data: bytes) -> None:
        with suppress(BlockingIOError):
            os.write(self._far, data)

    def _run(self) -> None:
        while not self._over.wait(self._period_s):
            self.turn()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        os.close(self._near)
        os.close(self._far)
