"""How a Python thread waits for an eventfd."""

from __future__ import annotations

import os


def wait_for(fd: int) -> None:
    """Sleep until an eventfd counts above zero, and reset it.

    The kernel may deliver a signal to any thread, and Python does not retry this call after EINTR.
    """
    while True:
        try:
            os.eventfd_read(fd)
        except InterruptedError:
            continue
        return
