"""Wait for an eventfd, called by the Python readers of records."""

from __future__ import annotations

import os


def wait_for(fd: int) -> None:
    """Sleep until the counter of an eventfd is above zero, and reset it.

    Retries after EINTR: the kernel may deliver a signal to any thread, and Python does not retry this call.
    """
    while True:
        try:
            os.eventfd_read(fd)
        except InterruptedError:
            continue
        return
