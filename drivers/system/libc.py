"""Calls of the C library on a file descriptor, for kernels: without allocation and without the interpreter lock."""

from __future__ import annotations

from errno import EAGAIN, EINTR, EIO
from select import POLLIN
from termios import FIONREAD, TCFLSH, TCOFLUSH, TIOCOUTQ
from typing import Any, Final

from numba import types

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import int64_at

_CPointer: Any = types.CPointer
IO_SIGNATURE: Final[Any] = types.int64(types.int64, _CPointer(types.float64))

TIMESPEC_WORDS: Final = 2
INTERRUPTED_MAX: Final = 4
"""Number of attempts of a call that signals interrupt."""

read_fd: Any = types.ExternalFunction("read", types.int64(types.int32, types.int64, types.uint64))
write_fd: Any = types.ExternalFunction("write", types.int64(types.int32, types.int64, types.uint64))
_ioctl: Any = types.ExternalFunction("ioctl", types.int32(types.int32, types.uint64, types.int64))
_poll: Any = types.ExternalFunction("poll", types.int32(types.int64, types.uint64, types.int32))
errno_location: Any = types.ExternalFunction("__errno_location", _CPointer(types.int32)())
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, _CPointer(types.int64)))


@jit
def read_monotonic_ns(timespec: int) -> int:
    """Return the time of the monotonic clock (ns); `timespec` is the address of two int64 for scratch."""
    at = int64_at(timespec)
    _clock_gettime(1, at)
    return int(at[0] * 1_000_000_000 + at[1])


def _retry_interrupted(call: Any) -> Any:
    @jit
    def retry(fd: int, address: int, size: int) -> int:
        for _ in range(INTERRUPTED_MAX):
            count: int = call(fd, address, size)
            if count >= 0:
                return count
            error = errno_location()[0]
            if error != EINTR:
                return -int(error)
        return -EAGAIN

    return retry


read_now: Any = _retry_interrupted(read_fd)
"""read_now(fd, address, size): bytes read from a non-blocking file, 0 at its end, or minus the error number."""

write_now: Any = _retry_interrupted(write_fd)
"""write_now(fd, address, size): bytes accepted by a non-blocking file, or minus the error number."""


@jit
def wait_readable(fd: int, timeout_ms: int, word: int) -> bool:
    """Wait until a file can be read; return False on a timeout or a signal.

    `word` is the address of an int64 for scratch.
    """
    int64_at(word)[0] = POLLIN << 32 | fd  # a pollfd: the file in the lower half, the requested events above it
    return bool(_poll(word, 1, timeout_ms) > 0)


@jit
def read_waiting(fd: int, address: int, size: int, word: int) -> int:
    """Read from a terminal like `read_now`, but return 0 if no byte is available.

    `word` is the address of an int64 for scratch. A plain read without available bytes does not return at once. It
    waits until a kernel thread has delivered bytes in transit (`n_tty_read` flushes the port's work): a quarter of a
    second if all processors are busy.
    """
    at = int64_at(word)
    at[0] = 0  # the ioctl writes only the lower half
    if _ioctl(fd, FIONREAD, word) != 0:
        return -int(errno_location()[0])
    if at[0] == 0:
        return 0
    count: int = read_now(fd, address, size)
    if count == 0:
        return -EIO
    return 0 if count == -EAGAIN else count


@jit
def count_unsent(fd: int, word: int) -> int:
    """Return the bytes written to a terminal that the system has not sent, or minus the error number.

    `word` is the address of an int64 for scratch. A USB modem (cdc-acm) counts a full buffer per write, a pseudo
    terminal nothing.
    """
    at = int64_at(word)
    at[0] = 0  # the ioctl writes only the lower half
    if _ioctl(fd, TIOCOUTQ, word) != 0:
        return -int(errno_location()[0])
    return int(at[0])


@jit
def drop_unsent(fd: int) -> None:
    """Drop the bytes written to a terminal that the system has not sent; those in a USB serial chip remain."""
    _ioctl(fd, TCFLSH, TCOFLUSH)
