"""Whether the system has put memory of the daemon on its disk: a tick that needs it waits for milliseconds."""

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
    "a tick that needs it waits for the disk: end what fills the memory, or let the daemon lock its own "
    "(softfinger doctor says how)"
)


class Swapping(Worker):
    """Looks at the start, and once a second, and tells it once, until all of it is back in memory.

    status  of the process, as proc_pid_status(5) has it
    """

    def __init__(self, event: Callable[..., Any], status: Path = STATUS) -> None:
        super().__init__("swapping")
        self._event, self._status = event, status
        self._told = False

    def work(self) -> None:
        self.look()
        while not self.closing.wait(PERIOD_S):
            self.look()

    def look(self) -> None:
        """Tell what is new since the last look."""
        kilobytes = swapped_kb(self._status.read_text())
        if kilobytes and not self._told:
            message = f"{kilobytes} kB of the daemon are in swap: {ADVICE}"
            log.warning("%s", message)
            self._event("fault", NAME, message=message)
        self._told = kilobytes > 0

    def failed(self, error: Exception) -> None:
        """What is rendered needs none of it: the run goes on."""
        self._event("fault", NAME, message=f"memory in swap is not told any more: {error}")


def swapped_kb(status: str) -> int:
    """Memory of a process in swap, kB; 0 where the system does not say."""
    found = re.search(r"^VmSwap:\s+(\d+) kB$", status, re.MULTILINE)
    return int(found[1]) if found else 0
