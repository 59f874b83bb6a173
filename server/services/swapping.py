"""Detection of memory of the daemon in swap: a tick that needs it waits for milliseconds."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
NAME: Final = "swapped"
STATUS: Final = Path("/proc/self/status")
ADVICE: Final = (
    "a tick that needs it waits for the disk: end the programs that fill the memory, or let the daemon lock its memory "
    "(see `softfinger doctor`)"
)


class Swapping(Worker):
    """Service that checks for swapped memory once per second, and reports it once until all of it is back.

    status  of the process, in the format of proc_pid_status(5)
    """

    def __init__(self, event: Callable[..., Any], status: Path = STATUS) -> None:
        super().__init__("swapping")
        self._event, self._status = event, status
        self._reported = False

    def work(self) -> None:
        self.check()
        while not self.closing.wait(PERIOD_S):
            self.check()

    def check(self) -> None:
        """Report memory in swap, unless it has been reported."""
        kilobytes = parse_swapped_kb(self._status.read_text())
        if kilobytes and not self._reported:
            message = f"{kilobytes} kB of the daemon are in swap: {ADVICE}"
            log.warning("%s", message)
            self._event("fault", NAME, message=message)
        self._reported = kilobytes > 0

    def handle_failure(self, error: Exception) -> None:
        """Publish an event; the run continues, because rendering does not depend on this service."""
        self._event("fault", NAME, message=f"memory in swap is no longer reported: {error}")


def parse_swapped_kb(status: str) -> int:
    """Return the memory of a process in swap, kB; 0 if the system does not report it."""
    match = re.search(r"^VmSwap:\s+(\d+) kB$", status, re.MULTILINE)
    return int(match[1]) if match else 0
