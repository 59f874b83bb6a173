"""Progress of what takes long: nothing for the first half second, then a line that says how far it is."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

QUIET_S = 0.5
TERMINAL_PERIOD_S = 0.2
PLAIN_PERIOD_S = 5.0

CHUNK = 65536
"""Ticks that an offline run does between two reports."""


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Report on `what` to stderr while the block runs; call the result with how many of `total` are done.

    On a terminal one line is kept up to date, elsewhere a line is printed every few seconds.
    """
    terminal = sys.stderr.isatty()
    begun, finished, count = time.monotonic(), threading.Event(), 0

    def done(number: int) -> None:
        nonlocal count
        count = number

    def line() -> str:
        share = f" {count / total:.0%}" if total else ""
        return f"{what}{share} ... {time.monotonic() - begun:.0f} s"

    def report() -> None:
        wait = QUIET_S
        while not finished.wait(wait):
            shown, end = (f"\r\x1b[K{line()}", "") if terminal else (line(), "\n")
            print(shown, end=end, file=sys.stderr, flush=True)
            wait = TERMINAL_PERIOD_S if terminal else PLAIN_PERIOD_S
        if terminal and wait != QUIET_S:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    reporter = threading.Thread(target=report, daemon=True)
    reporter.start()
    try:
        yield done
    finally:
        finished.set()
        reporter.join()
