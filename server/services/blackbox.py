"""Black box service: always on, it writes a file of the last ten seconds at every fault."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.recording.blackbox import BlackBox, find_folder, format_file_name, prepare_folder
from softfinger.server.services.base import Worker
from softfinger.server.services.records import Sink

log: Final = logging.getLogger(__name__)

POLL_S: Final = 0.1
TIME_AFTER_FAULT_S: Final = 0.5
"""Time after a fault that is also included in its file."""
MIN_INTERVAL_S: Final = 5.0
"""Minimum time between files; faults at shorter intervals share a file."""


class BlackBoxes(Worker):
    """Service that stores the latest records and events, and writes them to a file after a fault.

    No thread waits for it.

    servo     source of the ticks
    fingers   names of several fingers, an empty name for a single one
    describe  returns the description of the run, for the file
    """

    def __init__(self, servo: ServoThread, fingers: Sequence[str], describe: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__("blackbox")
        self._describe = describe
        self.box: Final = BlackBox(fingers, GUARD_NAMES, NS_PER_S / servo.period_ns)
        self.sink: Final = Sink("blackbox", lambda records, drops: self.box.take(records))
        self._due: tuple[float, Path] | None = None
        self._written_s = -MIN_INTERVAL_S
        self._number = 0
        self._lock = threading.Lock()
        logging.getLogger().addHandler(self.box.log)

    def stop(self) -> None:
        super().stop()
        logging.getLogger().removeHandler(self.box.log)

    def schedule_file(self, fault: str) -> str:
        """Return the file that will contain a present fault; empty if none can be created. Callable from any thread."""
        with self._lock:
            if self._due is None:
                directory = find_folder()
                if directory is None:
                    return ""
                self._number += 1
                self._due = time.monotonic() + TIME_AFTER_FAULT_S, directory / format_file_name(fault, self._number)
            return str(self._due[1])

    def work(self) -> None:
        while not self.closing.wait(POLL_S):
            self._write_due()
        self._write_due(last=True)

    def handle_failure(self, error: Exception) -> None:
        """Log the error; the run continues, because the black box only serves later analysis."""
        log.error("the black box has stopped: %s", error)

    def _write_due(self, last: bool = False) -> None:
        due, now = self._due, time.monotonic()
        if due is None or not (last or now >= max(due[0], self._written_s + MIN_INTERVAL_S)):
            return
        with self._lock:
            path, self._due = due[1], None
        self._written_s = now
        try:
            prepare_folder(path.parent)
            self.box.write(path, self._describe())
        except (OSError, ConfigError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            log.warning("the black box %s cannot be written: %s", path, reason)
            return
        log.info("the last 10 s are in %s", path)
