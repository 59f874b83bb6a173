"""Service: a part of the daemon that can be started and stopped, and may fail."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Final, Protocol

from softfinger.server.loop import shutdown

log: Final = logging.getLogger(__name__)

JOIN_S: Final = 2.0
"""Time for which `stop` waits for a thread; a thread that takes longer hangs, and the next service is stopped."""


class Service(Protocol):
    """Part of the daemon; services are started in order and stopped in reverse.

    `stop` is also called without `start`, since a service may own resources before it starts.
    """

    def start(self) -> None: ...

    def stop(self) -> None:
        """Stop and release all resources; raise an error only after every step has been attempted."""


class Worker(ABC):
    """Service with a thread that runs `work`; an exception of `work` is passed to `handle_failure`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.closing = threading.Event()
        """Set when `work` must return."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abstractmethod
    def work(self) -> None:
        """Run in the thread, until done or until `closing` is set."""

    @abstractmethod
    def handle_failure(self, error: Exception) -> None:
        """Handle an exception of `work`: define its effect on the run."""

    @property
    def native_id(self) -> int | None:
        """Native id of the thread; None before it is started."""
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
            self.handle_failure(error)


def stop_all(services: Iterable[Service], first: BaseException | None = None) -> BaseException | None:
    """Stop services in reverse order and return the first error, as `shutdown.run_all_steps` does."""
    return shutdown.run_all_steps(*(service.stop for service in reversed(list(services))), first=first)
