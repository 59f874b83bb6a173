"""Memory that a device's C functions share with Python: one block of int64 words, each declared once.

    class Fields(NamedTuple):
        frames: Annotated[int, counter("frames received")]
        fd: Annotated[int, word("file descriptor of the port, below 0 after closing")]
        values: Annotated[int, numbers("values of the latest frame", 8)]
        pose: Annotated[int, slot("latest pose", 7)]
        table: Annotated[int, address("rows of a report")]

    AT: Final = lay_out(Fields)

The address of the block is the device's handle, and `AT` is the word index of each field: a kernel accesses a word as
`int64_at(handle)[AT.fd]`, an array of numbers at the address `handle + 8 * AT.values`, and a sequence lock as
`slot_at(handle + 8 * AT.pose, 7)`. Kernels compile `AT` as constants. They are part of the source, which the kernel
cache is keyed by, so they cannot become stale.
"""

from __future__ import annotations

import ctypes
import logging
import time
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, TypeVar, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from softfinger.drivers.base import Device, DeviceIO
from softfinger.drivers.system.makers_library import find_address
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import exchange_int64, float64_array_at, int64_array_at
from softfinger.proxy.kernels.jit.seqlock import Slot

SEQUENCE_WORDS: Final = 8
"""Size of a sequence counter in int64: one cache line."""
CALL_PERIOD_S: Final = 1e-4

log: Final = logging.getLogger(__name__)

Layout = TypeVar("Layout", bound=tuple[int, ...])


@dataclass(frozen=True)
class BlockField:
    """Field of a layout: meaning, size in words, whether `Block.counts` includes it, name of a library's function."""

    doc: str
    word_count: int = 1
    counted: bool = False
    function: str = ""


def counter(doc: str) -> BlockField:
    """Declare a counter that only grows; the device's report lists it under the name of the field."""
    return BlockField(doc, counted=True)


def word(doc: str) -> BlockField:
    """Declare one int64."""
    return BlockField(doc)


def address(doc: str) -> BlockField:
    """Declare the address of an array of a length that depends on the rig, see `Block.set_address`."""
    return BlockField(doc)


def function(name: str) -> BlockField:
    """Declare the address of a function of a C library, see `Block.set_functions`."""
    return BlockField(name, function=name)


def numbers(doc: str, count: int) -> BlockField:
    """Declare `count` int64 or float64, stored in the block."""
    return BlockField(doc, count)


def raw_bytes(doc: str, count: int) -> BlockField:
    """Declare `count` bytes, stored in the block."""
    return BlockField(doc, -(-count // 8))


def slot(doc: str, count: int) -> BlockField:
    """Declare a sequence lock with `count` float64, so that its writer and its readers never wait for each other."""
    return BlockField(doc, SEQUENCE_WORDS + count)


@jit
def try_lock(handle: int, lock: int) -> bool:
    """Acquire the lock in word `lock` of a block; return False if another thread has it.

    A tick never waits for a lock: its owner is stopping the device, so that refusing a force is right.
    """
    return bool(exchange_int64(handle + 8 * lock, 1) == 0)


@jit
def unlock(handle: int, lock: int) -> None:
    exchange_int64(handle + 8 * lock, 0)


@jit
def slot_at(address: int, size: int) -> Slot:
    """Return the sequence lock of `size` float64 at an address."""
    sequence = int64_array_at(address, SEQUENCE_WORDS)
    return Slot(sequence, float64_array_at(address + 8 * SEQUENCE_WORDS, size))


@cache
def read_fields(fields: type[tuple[int, ...]]) -> dict[str, BlockField]:
    """Return the fields that a class declares, in their order."""
    hints = get_type_hints(fields, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items()}


def lay_out(fields: type[Layout], after: tuple[int, ...] | None = None) -> Layout:
    """Return the word indices of consecutive `fields`, which start at the end of the layout `after`, otherwise at 0."""
    at, starts = 0 if after is None else _end_of(after), []
    for field in read_fields(fields).values():
        starts.append(at)
        at += field.word_count
    return cast(Any, fields)(*starts)  # type: ignore[no-any-return]


def _end_of(layout: tuple[int, ...]) -> int:
    return layout[-1] + list(read_fields(type(layout)).values())[-1].word_count


class Block:
    """Block of one device, initially zero. It and the arrays it points to live as long as this object.

    layouts  consecutive layouts of the block; the last one determines its size
    """

    def __init__(self, *layouts: tuple[int, ...]) -> None:
        self.word: NDArray[np.int64] = np.zeros(_end_of(layouts[-1]), np.int64)
        self.handle = int(self.word.ctypes.data)
        """Address of the block."""
        self._layouts = layouts
        self._arrays: dict[int, NDArray[Any]] = {}

    def numbers(self, at: int, count: int) -> NDArray[np.float64]:
        """Return a view of the `count` float64 that start at word `at`."""
        return self.word[at : at + count].view(np.float64)

    def slot(self, at: int, count: int) -> Slot:
        """Return the sequence lock that starts at word `at` and protects `count` float64."""
        values = at + SEQUENCE_WORDS
        return Slot(self.word[at:values], self.numbers(values, count))

    def raw_bytes(self, at: int, count: int) -> NDArray[np.uint8]:
        """Return a view of the `count` bytes that start at word `at`."""
        return self.word[at : at + -(-count // 8)].view(np.uint8)[:count]

    def set_address(self, at: int, array: NDArray[Any]) -> None:
        """Store the address of an array in word `at`, and keep the array alive."""
        self._arrays[at] = array
        self.word[at] = array.ctypes.data

    def set_functions(self, library: ctypes.CDLL) -> None:
        """Store the addresses of all declared functions, which are in `library`."""
        for layout in self._layouts:
            for at, field in zip(layout, read_fields(type(layout)).values(), strict=True):
                if field.function:
                    self.word[at] = find_address(library, field.function)

    def counts(self, *layouts: tuple[int, ...]) -> dict[str, int]:
        """Return the present values of the counters of these layouts, or of all, by name."""
        return {
            name: int(self.word[at])
            for layout in layouts or self._layouts
            for at, (name, field) in zip(layout, read_fields(type(layout)).items(), strict=True)
            if field.counted
        }


class BlockDevice(Device):
    """Device with a block that its C functions `read` and `write` receive, and that contains its counters."""

    _block: Block
    _functions: tuple[Any, Any]
    _zero_failure = ""
    """Why the zero of the last `stop` failed."""

    def io(self) -> DeviceIO:
        read, write = self._functions
        return DeviceIO(read.address, write.address, self._block.handle)

    def zero_failure(self) -> str:
        return self._zero_failure

    def _report_zero_failure(self, failure: str, problem: str = "zero force has not reached it") -> None:
        """Store why the zero of this stop failed, and log the first of successive failures; empty: it did not fail.

        The loop, the daemon and `close` each stop the device.
        """
        if failure and not self._zero_failure:
            log.error("%s: %s: %s", self.info.name, problem, failure)
        self._zero_failure = failure

    def _call_until_done(self, function: Any, wait_s: float) -> bool:
        """Call a C function with the handle until it returns a true value; return False after `wait_s`."""
        until = time.monotonic() + wait_s
        while not function.ctypes(self._block.handle):
            if time.monotonic() > until:
                return False
            time.sleep(CALL_PERIOD_S)
        return True

    def counts(self) -> dict[str, int]:
        return self._block.counts()
