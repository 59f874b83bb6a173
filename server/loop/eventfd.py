"""Waking and waiting by eventfds, from compiled code and from Python."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.drivers.system.libc import read_fd, wait_readable
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import address_of

_eventfd_write: Any = types.ExternalFunction("eventfd_write", types.int32(types.int32, types.uint64))


@jit
def wake_eventfd(fd: int) -> None:
    """Wake the thread or process that sleeps on an eventfd."""
    _eventfd_write(fd, 1)


@jit
def reset_eventfd(fd: int, word: NDArray[np.int64]) -> None:
    """Reset an eventfd; wait for its signal if there is none. `word` (1,) is scratch memory."""
    read_fd(fd, address_of(word, 0), 8)


@jit
def poll_eventfd(fd: int, timeout_ms: int, word: NDArray[np.int64]) -> bool:
    """Sleep until an eventfd is signalled; return False after a timeout or EINTR. `word` (1,) is scratch memory."""
    return bool(wait_readable(fd, timeout_ms, address_of(word, 0)))


def wait_for_eventfd(fd: int) -> None:
    """Sleep until the counter of an eventfd is above zero, and reset it.

    Retries after EINTR: the kernel may deliver a signal to any thread, and Python does not retry this call.
    """
    while True:
        try:
            os.eventfd_read(fd)
        except InterruptedError:
            continue
        return
