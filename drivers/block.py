"""Memory that a device's C functions share with Python: one block of int64 words, each declared once.

    class Words(NamedTuple):
        frames: Annotated[int, counter("frames received")]
        fd: Annotated[int, word("file descriptor of the port, below 0 after closing")]
        values: Annotated[int, numbers("of the latest frame", 8)]
        table: Annotated[int, address("rows of a report")]

    AT: Final = lay_out(Words)

The address of the block is the device's handle, and `AT` is the word index of each field: a kernel accesses a word as
`int64_at(handle)[AT.fd]`, and an array of numbers at the address `handle + 8 * AT.values`. Kernels compile `AT` as
constants. They are part of the source, which the kernel cache is keyed by, so they cannot become stale.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

Layout = TypeVar("Layout", bound=tuple[int, ...])


@dataclass(frozen=True)
class Place:
    """Field of a layout: its meaning, its size in words, and whether `Block.counts` includes it."""

    doc: str
    words: int = 1
    counted: bool = False


def counter(doc: str) -> Place:
    """Declare a counter that only grows; the device's report lists it under the name of the field."""
    return Place(doc, counted=True)


def word(doc: str) -> Place:
    """Declare one int64."""
    return Place(doc)


def address(doc: str) -> Place:
    """Declare the address of an array of a length that depends on the rig, see `Block.point`."""
    return Place(doc)


def numbers(doc: str, count: int) -> Place:
    """Declare `count` int64 or float64, stored in the block."""
    return Place(doc, count)


def octets(doc: str, count: int) -> Place:
    """Declare `count` bytes, stored in the block."""
    return Place(doc, -(-count // 8))


@cache
def places(words: type[tuple[int, ...]]) -> dict[str, Place]:
    """Return the fields of a layout, in their order."""
    hints = get_type_hints(words, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items()}


def lay_out(words: type[Layout], after: tuple[int, ...] | None = None) -> Layout:
    """Return the word index of each field of the layout `words`: consecutive, and after the layout `after` if given."""
    at, begins = 0 if after is None else _end(after), []
    for place in places(words).values():
        begins.append(at)
        at += place.words
    return cast(Any, words)(*begins)  # type: ignore[no-any-return]


def _end(layout: tuple[int, ...]) -> int:
    return layout[-1] + list(places(type(layout)).values())[-1].words


class Block:
    """Block of one device, initially zero. It and the arrays it points to live as long as this object.

    layouts  consecutive layouts of the block; the last one determines its size
    """

    def __init__(self, *layouts: tuple[int, ...]) -> None:
        self.word: NDArray[np.int64] = np.zeros(_end(layouts[-1]), np.int64)
        self.handle = int(self.word.ctypes.data)
        """Address of the block."""
        self._layouts = layouts
        self._kept: dict[int, NDArray[Any]] = {}

    def numbers(self, at: int, count: int) -> NDArray[np.float64]:
        """Return a view of `count` float64 from word `at`."""
        return self.word[at : at + count].view(np.float64)

    def octets(self, at: int, count: int) -> NDArray[np.uint8]:
        """Return a view of `count` bytes from word `at`."""
        return self.word[at : at + -(-count // 8)].view(np.uint8)[:count]

    def point(self, at: int, array: NDArray[Any]) -> None:
        """Store the address of an array in word `at`, and keep the array alive."""
        self._kept[at] = array
        self.word[at] = array.ctypes.data

    def counts(self, *layouts: tuple[int, ...]) -> dict[str, int]:
        """Return the present values of the counters of these layouts, or of all, by name."""
        return {
            name: int(self.word[at])
            for layout in layouts or self._layouts
            for at, (name, place) in zip(layout, places(type(layout)).items(), strict=True)
            if place.counted
        }
