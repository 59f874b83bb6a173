"""A thread of Python that sleeps on an eventfd."""

from __future__ import annotations

import os


def wait_for(fd: int) -> None:
    """Sleep until an eventfd rings, and take back what rang.

    The system gives a signal to any thread, and Python repeats this call for none that a handler interrupted.
    """
    while True:
        try:
            os.eventfd_read(fd)
        except InterruptedError:
            continue
        return
