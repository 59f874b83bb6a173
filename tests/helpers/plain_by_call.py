"""Run a driver's exchange call by call as plain Python, with a clock set by the test and scripted calls of the system
or of a vendor's library. Nothing waits and no thread runs.

Operations that only machine code can do are done by ctypes. These tests are marked `plain`, and skipped if kernels are
compiled.
"""

import ctypes
from collections.abc import Callable
from errno import EAGAIN, EIO
from types import ModuleType
from typing import Any, ClassVar, Final

import numpy as np
import pytest
from numba import config
from numpy.typing import NDArray
from references.rotation import rodrigues

from softfinger.drivers import block
from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import Block
from softfinger.proxy.kernels.jit import pack, seqlock

BY_CALL = [
    pytest.mark.plain,
    pytest.mark.skipif(
        not config.DISABLE_JIT,
        reason="it scripts calls in Python, and compiled code cannot call Python; `make test` runs it uncompiled",
    ),
]
MS = 1_000_000
START_NS = 10_000 * MS
"""Initial time of the clock."""
NOT_OURS = 0x7FF8_0000_DEAD_BEEF
"""Guard word around a block; as float64 it is not a number."""


def exchange_int64(address: int, value: int) -> int:
    """Like the function in proxy.kernels.jit.memory."""
    word = ctypes.c_int64.from_address(int(address))
    before, word.value = word.value, value
    return before


def unpack_at(like: Any, address: int) -> Any:
    """Like the function in proxy.kernels.jit.pack."""
    leaves = len(pack.flatten(like))
    return pack.unflatten(like, list((ctypes.c_double * leaves).from_address(int(address))))


def _load(array: Any, index: int) -> int:
    return int(array[index])


def _store(array: Any, index: int, value: int) -> None:
    array[index] = value


def _no_fence() -> None:
    """Do nothing: plain Python executes in order."""


ORDERED: Final[dict[str, Callable[..., Any]]] = {
    "load_acquire": _load, "load_relaxed": _load, "store_release": _store, "store_relaxed": _store,
    "fence_acquire": _no_fence, "fence_release": _no_fence,
}  # fmt: skip
"""Words of memory, like those of proxy.kernels.jit.atomics."""


class Clock:
    """The time (ns); in a block, at the address where the system would write it."""

    def __init__(self) -> None:
        self.now = START_NS
        self.room: set[int] = set()

    def __call__(self, timespec: int) -> int:
        """Like `read_monotonic_ns`."""
        assert timespec in self.room
        return self.now


class GuardedBlock(Block):
    """A block inside a larger memory, with as much memory before and after it as its own size.

    fixed  first words and ends that no call may change
    """

    def __init__(self, *layouts: tuple[int, ...]) -> None:
        super().__init__(*layouts)
        words = len(self.word)
        self._around = np.full(3 * words, NOT_OURS, np.int64)
        self.word = self._around[words : 2 * words]
        self.word[:] = 0
        self.handle = int(self.word.ctypes.data)
        self.fixed: list[tuple[int, int]] = []

    def call(self, function: Any, *arguments: Any) -> int:
        """Return the result of a C function for this handle, after it has written its output."""
        before = [self.word[first:end].copy() for first, end in self.fixed]
        status = int(function(self.handle, *arguments))
        for part in np.split(self._around, 3)[::2]:
            assert (part == NOT_OURS).all(), "it has written outside the block"
        for (first, end), words in zip(self.fixed, before, strict=True):
            assert (self.word[first:end] == words).all(), "it has changed what is not its own"
        return status


def by_call(patch: pytest.MonkeyPatch, *modules: ModuleType) -> Clock:
    """Replace the clock, the blocks and all machine-code operations of these modules by plain Python."""
    clock = Clock()
    here = {"read_monotonic_ns": clock, "exchange_int64": exchange_int64, "unpack_at": unpack_at, "Block": GuardedBlock}
    for module in (*modules, block):
        for name, does in here.items():
            if hasattr(module, name):
                patch.setattr(module, name, does)
    for name, does in ORDERED.items():
        patch.setattr(seqlock, name, does)
    return clock


class FarEnd:
    """Far end of a driver, by a script, and the driver's calls; the base of those of the tests."""

    exchange: ClassVar[Any]
    """Module of the driver's exchange."""
    clock: Clock
    block: GuardedBlock

    @property
    def word(self) -> NDArray[np.int64]:
        return self.block.word

    def read(self) -> tuple[int, NDArray[np.float64]]:
        sample = np.full(SAMPLE_SIZE, np.nan)
        return self.block.call(self.exchange.read, sample), sample

    def write(self, *wrench: float) -> int:
        return self.block.call(self.exchange.write, wrench)

    def counts(self) -> dict[str, int]:
        """Return the counters that are not zero."""
        return {name: count for name, count in self.block.counts().items() if count}


class File:
    """A scripted file descriptor of the system.

    incoming  results of the reads, in order; of bytes in a stream a read returns as many as it requests
    room      bytes that it accepts; None: any number; below 0: none, and it returns 0 instead of the error
    error     of the system, for reads and writes; 0: none
    """

    def __init__(self, number: int, packets: bool = False) -> None:
        self.number, self._packets = number, packets
        self.incoming: list[bytes] = []
        self.room: int | None = None
        self.error = 0
        self.sent: list[bytes] = []
        self.reads = 0

    def read(self, fd: int, address: int, size: int) -> int:
        """Like `read_now`."""
        assert fd == self.number
        self.reads += 1
        if self.error:
            return -self.error
        if not self.incoming:
            return -EAGAIN
        data, rest = self.incoming[0][:size], self.incoming[0][size:]
        ctypes.memmove(address, data, len(data))
        self.incoming[:1] = [rest] if rest and not self._packets else []
        return len(data)

    def read_waiting(self, fd: int, address: int, size: int, word: int) -> int:
        """Like the function of this name."""
        count = self.read(fd, address, size)
        ctypes.c_int64.from_address(word).value = len(b"".join(self.incoming)) + max(count, 0)
        return -EIO if count == 0 else max(count, 0) if count == -EAGAIN else count

    def write(self, fd: int, address: int, size: int) -> int:
        """Like `write_now`."""
        assert fd == self.number
        if self.error:
            return -self.error
        count = size if self.room is None else min(size, self.room)
        if count <= 0:
            return -EAGAIN if count == 0 else 0
        self.sent.append(ctypes.string_at(int(address), count))
        if self.room is not None:
            self.room -= count
        return count


def matrix(q: NDArray[np.float64] | list[float]) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a unit quaternion (w, x, y, z), from the definition q e q*."""
    w, v = q[0], np.asarray(q[1:4])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray((w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross)


def turned(axis: int, angle: float) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) about axis 0, 1 or 2."""
    return rodrigues(angle * np.eye(3)[axis])


ABOUT_Z, SHIFT = turned(2, np.pi / 2), (0.1, 0.2, 0.3)
HALF = float(np.sqrt(0.5))
MOUNTING = {"position_m": list(SHIFT), "orientation_wxyz": [HALF, 0.0, 0.0, HALF]}
"""Mounting of the devices in these tests: a quarter turn, and m."""


def check_pose(sample: NDArray[np.float64], place: tuple[float, ...], q: tuple[float, ...], rounding: float) -> None:
    """Check position (m) and orientation of the device's frame in the world; `rounding` applies to the matrix."""
    np.testing.assert_allclose(sample[:3], ABOUT_Z @ place + SHIFT, atol=1e-12)
    np.testing.assert_allclose(matrix(sample[3:7]), ABOUT_Z @ matrix(list(q)), atol=rounding)
