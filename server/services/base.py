"""A service: a part of the daemon that is started, stopped, and may fail."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Final, Protocol

from softfinger.server.loop import shutdown

log: Final = logging.getLogger(__name__)

JOIN_S: Final = 2.0
"""How long a stop waits for a thread. One that has not ended by then hangs, and the others have their turn."""


class Service(Protocol):
    """Started in order, stopped in reverse; `stop` also of what was never started, for it may hold something."""

    def start(self) -> None: ...

    def stop(self) -> None:
        """End, and release what is held; what fails is raised once every step was taken."""


class Worker(ABC):
    """A service with a thread of its own, which does `work`; what that raises goes to `failed`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.closing = threading.Event()
        """Set when the work is to end."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abstractmethod
    def work(self) -> None:
        """What the thread does, until it is done or `closing` is set."""

    @abstractmethod
    def failed(self, error: Exception) -> None:
        """What it means for the run that the work failed."""

    @property
    def native_id(self) -> int | None:
        """Of the thread; None before it is started."""
        return self._thread.native_id

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self.closing.set()
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)

    def _run(self) -> None:
        try:
            self.work()
        except Exception as error:
            log.exception("%s failed", self.name)
            self.failed(error)


def stop_all(services: Iterable[Service], first: BaseException | None = None) -> BaseException | None:
    """Stop services, the last of them first; the first error, as of `shutdown.every`."""
    return shutdown.every(*(service.stop for service in reversed(list(services))), first=first)
