"""The black box as a service: always on, and a file of the last ten seconds for every fault."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.loop.servo_thread import Servo
from softfinger.server.recording.blackbox import BlackBox, folder, make_room, name_of
from softfinger.server.services.base import Worker
from softfinger.server.services.records import Sink

log: Final = logging.getLogger(__name__)

POLL_S: Final = 0.1
AFTER_S: Final = 0.5
"""What comes within this behind a fault is in its file, too."""
APART_S: Final = 5.0
"""Faults that come faster than this share a file."""


class BlackBoxes(Worker):
    """Keeps what comes, and writes it once something has failed; nobody waits for it.

    servo     whose ticks are kept
    fingers   names of several fingers, one empty name for a single one
    describe  what the run is made of, for the file
    """

    def __init__(self, servo: Servo, fingers: Sequence[str], describe: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__("blackbox")
        self._describe = describe
        self.box: Final = BlackBox(fingers, GUARD_NAMES, NS_PER_S / servo.period_ns)
        self.sink: Final = Sink("blackbox", self._take)
        self._due: tuple[float, Path] | None = None
        self._written_s = -APART_S
        self._number = 0
        self._lock = threading.Lock()
        logging.getLogger().addHandler(self.box.log)

    def stop(self) -> None:
        super().stop()
        logging.getLogger().removeHandler(self.box.log)

    def due(self, fault: str) -> str:
        """The file that a fault of now will be in; empty where none can be made. From any thread."""
        with self._lock:
            if self._due is None:
                place = folder()
                if place is None:
                    return ""
                self._number += 1
                self._due = time.monotonic() + AFTER_S, place / name_of(fault, self._number)
            return str(self._due[1])

    def tell(self, event: Mapping[str, Any]) -> None:
        """Keep an event that is published; from any thread."""
        self.box.event(event)

    def work(self) -> None:
        while not self.closing.wait(POLL_S):
            self._look()
        self._look(last=True)

    def failed(self, error: Exception) -> None:
        """The run goes on without it: it is there for those who look afterwards."""
        log.error("the black box has ended: %s", error)

    def _look(self, last: bool = False) -> None:
        due, now = self._due, time.monotonic()
        if due is None or not (last or now >= max(due[0], self._written_s + APART_S)):
            return
        with self._lock:
            path, self._due = due[1], None
        self._written_s = now
        try:
            make_room(path.parent)
            self.box.write(path, self._describe())
        except (OSError, ConfigError) as error:
            said = error.strerror if isinstance(error, OSError) and error.strerror else error
            log.warning("the black box %s cannot be written: %s", path, said)
            return
        log.info("the last 10 s are in %s", path)

    def _take(self, records: NDArray[np.float64], drops: int) -> None:
        self.box.take(records)
