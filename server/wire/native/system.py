"""The C library as the sender calls it: sockets that never make it wait, an eventfd, a lock without an interpreter."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.drivers.system.libc import EAGAIN, EINTR, errno_location
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.memory import address_of

POLLIN: Final = 1
POLLOUT: Final = 4
_REVENTS: Final = 48
"""A pollfd is one word of 64 bits: the file in the low half, what is asked for above it, what happened on top."""
_FOREVER_MS: Final = -1
_NOW: Final = 0x4040
"""MSG_DONTWAIT | MSG_NOSIGNAL: a full buffer is no reason to wait, a peer that went is none for a signal."""

LOCK_WORDS: Final = 8
"""A pthread_mutex_t has 40 bytes, 48 on some processors; zeros are one that is free."""

GONE: Final = -1
FULL: Final = 0

_send: Any = types.ExternalFunction("send", types.int64(types.int32, types.int64, types.uint64, types.int32))
_poll: Any = types.ExternalFunction("poll", types.int32(types.int64, types.uint64, types.int32))
_read: Any = types.ExternalFunction("read", types.int64(types.int32, types.int64, types.uint64))
_eventfd_write: Any = types.ExternalFunction("eventfd_write", types.int32(types.int32, types.uint64))
_mutex_lock: Any = types.ExternalFunction("pthread_mutex_lock", types.int32(types.int64))
_mutex_unlock: Any = types.ExternalFunction("pthread_mutex_unlock", types.int32(types.int64))


@jit
def lock(words: NDArray[np.int64]) -> None:
    """Take the lock in LOCK_WORDS words. Held for microseconds and by kernels only, so that nobody who holds it ever
    waits for the interpreter."""
    _mutex_lock(address_of(words, 0))


@jit
def unlock(words: NDArray[np.int64]) -> None:
    _mutex_unlock(address_of(words, 0))


@jit
def give(fd: int, address: int, size: int) -> int:
    """Hand bytes to a socket: how many it took at once, FULL, or GONE."""
    taken = _send(fd, address, size, _NOW)
    if taken >= 0:
        return int(taken)
    error = errno_location()[0]
    return FULL if error in (EAGAIN, EINTR) else GONE


@jit
def ring(fd: int) -> None:
    """Wake whoever sleeps on an eventfd."""
    _eventfd_write(fd, 1)


@jit
def silence(fd: int, word: NDArray[np.int64]) -> None:
    """Take back what rang; `word` (1,) is overwritten. Waits if nothing did."""
    _read(fd, address_of(word, 0), 8)


@jit
def asked(fd: int, events: int) -> int:
    """A pollfd."""
    return int(events << 32 | fd)


@jit
def sleep_on(files: NDArray[np.int64], count: int, timeout_ms: int) -> bool:
    """Sleep until something happens to one of the first `count` pollfds; False for the time-out, or a signal."""
    return bool(_poll(address_of(files, 0), count, timeout_ms) > 0)


@jit
def happened(pollfd: int) -> bool:
    return bool(pollfd >> _REVENTS & 0xFFFF)
