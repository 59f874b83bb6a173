"""Ring buffer of all ticks in memory that other programs of the same user may read.

It is a file in /dev/shm of mode 600: a page of int64 numbers, then the rows. Readers map it read-only, so they can
affect neither it nor its writer. They sleep on a counter used as a futex, which the relay increments and wakes after
each write. `softfinger_ring.h` is the same reader in C.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import logging
import mmap
import os
import platform
import secrets
import time
import weakref
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.drivers.closeable import Closeable
from softfinger.proxy.kernels.jit.atomics import load_acquire, load_relaxed, store_release
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.memory import address_of
from softfinger.server.wire.native.broadcast import Broadcast, make_read_position, read_rows

log: Final = logging.getLogger(__name__)

_libc: Final = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long)
_libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)

ALIVE_PERIOD_S: Final = 0.5
"""Interval at which a waiting reader checks whether the daemon still runs."""

FOLDER: Final = Path("/dev/shm")
PREFIX: Final = "softfinger-"
MAGIC: Final = int.from_bytes(b"softfing", "little")
LAYOUT: Final = 1
"""Version of the layout, incremented when a header entry or the rows change their place or meaning."""

# Indices in the first page; the eight numbers from HEAD on are the head of the ring buffer.
_MAGIC, _LAYOUT, _CAPACITY, _WIDTH, _ENDED = range(5)
HEAD: Final = 8
PAGE_BYTES: Final = 4096

_BELL: Final = 1
"""Index in the head of the counter of wake-ups; its lower half is the futex."""
_FUTEX: Final = {"x86_64": 202, "aarch64": 98}.get(platform.machine(), -1)
_WAIT: Final = 0
_WAKE: Final = 1
_ALL: Final = 0x7FFFFFFF
_syscall: Any = types.ExternalFunction(
    "syscall", types.int64(types.int64, types.int64, types.int64, types.int64, types.int64, types.int64, types.int64)
)


class RingMemory(NamedTuple):
    """Ring buffer that other programs may read.

    broadcast  ring buffer
    words      (n,) int64, all of the memory
    name       in /dev/shm, '' if only the publisher can read it
    fd         its file, locked as long as the writer exists
    reading    the same file, opened read-only
    """

    broadcast: Broadcast
    words: NDArray[np.int64]
    name: str
    fd: int
    reading: int


def make_memory(capacity: int, width: int) -> RingMemory:
    """Return a ring buffer that other programs of this user can map; without shared memory, only the publisher can."""
    size = PAGE_BYTES + 8 * capacity * width
    try:
        if _FUTEX < 0:
            raise OSError(errno.ENOSYS, f"futex is not supported on {platform.machine()}")
        remove_stale_files()
        fd, name = _create_locked()
        try:
            words, reading = _allocate(fd, size)
        except BaseException:
            (FOLDER / name).unlink(missing_ok=True)
            os.close(fd)
            raise
    except OSError as error:
        log.warning("telemetry: local readers cannot use shared memory: %s: %s", FOLDER, error.strerror)
        fd, name = os.memfd_create("softfinger"), ""
        words, reading = _allocate(fd, size)
    words[_LAYOUT], words[_CAPACITY], words[_WIDTH] = LAYOUT, capacity, width
    words[_MAGIC] = MAGIC
    return RingMemory(_as_broadcast(words), words, name, fd, reading)


def _allocate(fd: int, size: int) -> tuple[NDArray[np.int64], int]:
    """Return the given number of bytes of a new file, as int64, and the same file opened read-only."""
    # Allocated now: if the system had no room, a later write would crash the process.
    os.posix_fallocate(fd, 0, size)
    return map_file(fd, size), os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC)


def _create_locked() -> tuple[int, str]:
    """Create and lock a file; return it and its name."""
    while True:
        name = f"{PREFIX}{secrets.token_hex(8)}"
        fd = os.open(FOLDER / name, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(fd, fcntl.LOCK_EX)
        if os.fstat(fd).st_nlink:  # otherwise another daemon removed it before it was locked
            return fd, name
        os.close(fd)


def map_file(fd: int, size: int) -> NDArray[np.int64]:
    """Map a file as an int64 array, for as long as the array exists.

    Not with `mmap`, which would keep a duplicate of the file open.
    """
    address = _libc.mmap(None, size, mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_SHARED, fd, 0)
    if address == ctypes.c_void_p(-1).value:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    block = (ctypes.c_int64 * (size // 8)).from_address(address)
    weakref.finalize(block, _libc.munmap, address, size)
    return np.ctypeslib.as_array(block)


def _as_broadcast(words: NDArray[np.int64]) -> Broadcast:
    capacity, width = int(words[_CAPACITY]), int(words[_WIDTH])
    slots = words[PAGE_BYTES // 8 :].view(np.float64)[: capacity * width].reshape(capacity, width)
    return Broadcast(slots, words[HEAD : HEAD + 8])


def remove(memory: RingMemory) -> None:
    """Notify readers of the end, and remove the name; readers that have mapped the memory can still read it."""
    memory.words[_ENDED] = 1
    wake_readers(memory.broadcast)
    release(memory)


def release(memory: RingMemory) -> None:
    """Remove the name and close the files; without a compiled kernel, and so also after an interrupted compilation."""
    if memory.name:
        (FOLDER / memory.name).unlink(missing_ok=True)
    os.close(memory.fd)
    os.close(memory.reading)


def remove_stale_files() -> None:
    """Remove the files of killed daemons of this user: files without a lock."""
    for path in FOLDER.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            fd = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if os.fstat(fd).st_uid == os.geteuid():  # root can open files of other users, and must not remove them
                    fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    path.unlink()
            finally:
                os.close(fd)


@entry
def wake_readers(broadcast: Broadcast) -> None:
    """Wake all readers that sleep on a ring buffer, after rows were written to it."""
    store_release(broadcast.head, _BELL, load_relaxed(broadcast.head, _BELL) + 1)
    _syscall(_FUTEX, address_of(broadcast.head, _BELL), _WAKE, _ALL, 0, 0, 0)


@entry
def sleep(broadcast: Broadcast, bell: int, timespec: NDArray[np.int64]) -> None:
    """Sleep until readers have been woken more than `bell` times, for at most `timespec`, (2,) s and ns."""
    _syscall(_FUTEX, address_of(broadcast.head, _BELL), _WAIT, bell & 0xFFFFFFFF, address_of(timespec, 0), 0, 0)


class Local(Closeable):
    """Reader of every tick of a daemon on this machine, from the memory that `describe` returns as `ring`.

    Raises ConfigError if the memory does not exist, or belongs to another user or version. For one thread only.
    """

    def __init__(self, name: str) -> None:
        if not name.startswith(PREFIX) or "/" in name:
            raise ConfigError(f"{name!r} is not the name of a daemon's ticks: see softfinger ctl describe")
        with ExitStack() as opened:
            try:
                self._fd = os.open(FOLDER / name, os.O_RDONLY | os.O_CLOEXEC)
                opened.callback(os.close, self._fd)
                words = np.frombuffer(mmap.mmap(self._fd, 0, prot=mmap.PROT_READ), np.int64)
            except (OSError, ValueError) as error:
                raise ConfigError(
                    f"the ticks {name} cannot be read: {error}: check that the daemon is running"
                ) from error
            if len(words) * 8 <= PAGE_BYTES or (words[_MAGIC], words[_LAYOUT]) != (MAGIC, LAYOUT):
                raise ConfigError(f"{name} does not have layout {LAYOUT}: use the client of the daemon's version")
            opened.pop_all()
        self._words, self._broadcast = words, _as_broadcast(words)
        self._position = make_read_position(self._broadcast)
        self._rows = np.empty((256, int(words[_WIDTH])))

    def take(self, timeout_s: float) -> NDArray[np.float64]:
        """Return the oldest unread ticks as soon as there are some, (n, fingers x RECORD_SIZE).

        Returns no ticks after the timeout, or at the end. The next call overwrites the array.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            ended, bell = self.ended, int(load_word(self._broadcast.head, _BELL))
            count = int(read_rows(self._broadcast, self._position, self._rows))
            remaining_s = until_s - time.monotonic()
            if count or ended or remaining_s <= 0.0:
                return self._rows[:count]
            part_s = min(remaining_s, ALIVE_PERIOD_S)
            sleep(self._broadcast, bell, np.array([int(part_s), int(part_s % 1.0 * 1e9)]))

    @property
    def lost(self) -> int:
        """Ticks that were overwritten before they were read."""
        return int(self._position.lost[0])

    @property
    def ended(self) -> bool:
        """True if the daemon has exited; available ticks can still be read."""
        if self._words[_ENDED]:
            return True
        try:
            fcntl.flock(self._fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return False
        fcntl.flock(self._fd, fcntl.LOCK_UN)
        return True

    def close(self) -> None:
        """Close the file; may be called repeatedly. Arrays returned before remain readable."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


@entry
def load_word(words: NDArray[np.int64], index: int) -> int:
    """Return a number that another program writes."""
    value: int = load_acquire(words, index)
    return value
