"""Lines on standard error, which no thread waits for.

The reader of a pipe, a terminal or a log service may stop reading. A write would then block its thread, with the lock
of the log that all other threads need.
"""

from __future__ import annotations

import contextlib
import select
import sys
from typing import Final

LAST_WAIT_S: Final = 1.0
"""Time for which the last line of a program waits."""

_lost_lines = 0


def write_line(text: str, wait_s: float = 0.0) -> None:
    """Write a line, or drop it if standard error takes none within `wait_s`; a later line gives the number dropped."""
    global _lost_lines
    if not is_writable(wait_s):
        _lost_lines += 1
        return
    lost, _lost_lines = _lost_lines, 0
    print(f"({lost} lines are missing here: they were not read in time)\n{text}" if lost else text, file=sys.stderr)
    sys.stderr.flush()


def is_writable(wait_s: float = 0.0) -> bool:
    """Return whether standard error takes a line now, or within `wait_s`."""
    with contextlib.suppress(OSError, ValueError):  # standard error has no file
        waiting = select.poll()
        waiting.register(sys.stderr.fileno(), select.POLLOUT)
        return bool(waiting.poll(1000.0 * wait_s))
    return True
