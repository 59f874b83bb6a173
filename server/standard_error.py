"""Lines on standard error, which no thread waits for.

The reader of a pipe, a terminal or a log service may stop reading. A write would then block its thread, with the lock
of the log that all other threads need.
"""

from __future__ import annotations

import contextlib
import select
import sys
from typing import Any, Final, TextIO

LAST_WAIT_S: Final = 1.0
"""Time for which the last line of a program waits."""
WRITE_CHARACTERS: Final = 1000
"""Characters of one write, at most 4 bytes each: a pipe that poll(2) reports as writable takes 4096 bytes at once."""

_lost_lines = 0


class NonBlockingStream:
    """Stream that discards what standard error does not accept at once; otherwise as `stream`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        for start in range(0, len(text), WRITE_CHARACTERS):
            if is_writable():
                self._stream.write(text[start : start + WRITE_CHARACTERS])
                self._stream.flush()
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def write_line(text: str, wait_s: float = 0.0) -> None:
    """Write a line, or drop it if it is not accepted within `wait_s`; a later line counts the dropped ones."""
    global _lost_lines
    notice = f"({_lost_lines} lines are missing here: they were not read in time)\n" if _lost_lines else ""
    line = f"{notice}{text}\n"
    for start in range(0, len(line), WRITE_CHARACTERS):
        if not is_writable(wait_s):
            _lost_lines += 1
            return
        sys.stderr.write(line[start : start + WRITE_CHARACTERS])
        sys.stderr.flush()
    if notice:
        _lost_lines = 0


def is_writable(wait_s: float = 0.0) -> bool:
    """Return whether standard error accepts a line within `wait_s` (s)."""
    with contextlib.suppress(OSError, ValueError):  # standard error has no file
        poller = select.poll()
        poller.register(sys.stderr.fileno(), select.POLLOUT)
        return bool(poller.poll(1000.0 * wait_s))
    return True
