"""Far end of a pseudo terminal, for boards emulated by a thread in Python."""

import os
import threading
import tty
from contextlib import AbstractContextManager, suppress
from typing import Any, Self


class Terminal(AbstractContextManager[Any]):
    """Both ends, and a thread that runs `_run` until the board is pulled; `path` is for the driver."""

    def __init__(self) -> None:
        self._far, self._near = os.openpty()
        os.set_blocking(self._far, False)
        self.path = os.ttyname(self._near)
        self.mute = threading.Event()
        """If set, the board receives but does not answer."""
        self._pulled = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        raise NotImplementedError

    def say(self, data: bytes) -> bool:
        """Send bytes to the host unchanged; return False if they are lost because the buffer is full."""
        with suppress(OSError):
            return os.write(self._far, data) == len(data)
        return False

    def power_off(self) -> None:
        pass

    def pull(self) -> None:
        if not self.pulled:
            self._pulled.set()
            self._thread.join()
            self.power_off()
            os.close(self._near)
            os.close(self._far)

    @property
    def pulled(self) -> bool:
        return self._pulled.is_set()

    def __exit__(self, *_: object) -> None:
        self.pull()


class FarTerminal(Terminal):
    """Call `turn` every `period_s` until the block ends."""

    def __init__(self, period_s: float) -> None:
        super().__init__()
        tty.setraw(self._near)
        self._period_s = period_s

    def turn(self) -> None:
        raise NotImplementedError

    def read(self) -> bytes:
        """Return the bytes received since the last call."""
        with suppress(BlockingIOError):
            return os.read(self._far, 4096)
        return b""

    def _run(self) -> None:
        while not self._pulled.wait(self._period_s):
            self.turn()

    def __enter__(self) -> Self:
        self._thread.start()
        return self
