"""The memory that a device's C functions share with Python: one block of int64 words, each declared once.

    class Words(NamedTuple):
        frames: Annotated[int, counter("frames received")]
        fd: Annotated[int, word("the port, below 0 once it is closed")]
        values: Annotated[int, numbers("of the newest frame", 8)]
        table: Annotated[int, address("rows of a report")]

    AT: Final = lay_out(Words)

The address of the block is the device's handle, and `AT` says at which word each thing begins: a kernel has the words
in `int64_at(handle)[AT.fd]`, numbers at the address `handle + 8 * AT.values`. To a kernel `AT` is constants; they are
part of the code, and the kernel cache is keyed by the source, so they cannot go stale.
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
    """What a field of a layout stands for: so many words, and whether they count for `Block.counts`."""

    doc: str
    words: int = 1
    counted: bool = False


def counter(doc: str) -> Place:
    """A word that only grows, in the device's report under its own name."""
    return Place(doc, counted=True)


def word(doc: str) -> Place:
    """One int64."""
    return Place(doc)


def address(doc: str) -> Place:
    """The address of an array that is as long as the rig says, see `Block.point`."""
    return Place(doc)


def numbers(doc: str, count: int) -> Place:
    """So many int64 or float64, in the block itself."""
    return Place(doc, count)


def octets(doc: str, count: int) -> Place:
    """So many bytes, in the block itself."""
    return Place(doc, -(-count // 8))


@cache
def places(words: type[tuple[int, ...]]) -> dict[str, Place]:
    """What a layout's fields stand for, in their order."""
    hints = get_type_hints(words, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items()}


def lay_out(words: type[Layout], after: tuple[int, ...] | None = None) -> Layout:
    """At which word of the block each field of `words` begins: one behind the other, behind the layout `after`."""
    at, begins = 0 if after is None else _end(after), []
    for place in places(words).values():
        begins.append(at)
        at += place.words
    return cast(Any, words)(*begins)  # type: ignore[no-any-return]


def _end(layout: tuple[int, ...]) -> int:
    return layout[-1] + list(places(type(layout)).values())[-1].words


class Block:
    """The block of one device, 0 throughout at first; it is there, and what it points to, as long as this object.

    layouts  those of which the last is the longest
    """

    def __init__(self, *layouts: tuple[int, ...]) -> None:
        self.word: NDArray[np.int64] = np.zeros(_end(layouts[-1]), np.int64)
        """The words."""
        self.handle = int(self.word.ctypes.data)
        """Their address."""
        self._layouts = layouts
        self._kept: dict[int, NDArray[Any]] = {}

    def numbers(self, at: int, count: int) -> NDArray[np.float64]:
        """The float64 (count,) that begin at a word."""
        return self.word[at : at + count].view(np.float64)

    def octets(self, at: int, count: int) -> NDArray[np.uint8]:
        """The bytes (count,) that begin at a word."""
        return self.word[at : at + -(-count // 8)].view(np.uint8)[:count]

    def point(self, at: int, array: NDArray[Any]) -> None:
        """Keep an array, and its address in a word."""
        self._kept[at] = array
        self.word[at] = array.ctypes.data

    def counts(self, *layouts: tuple[int, ...]) -> dict[str, int]:
        """The counters by name as they are just now: those of these layouts, or all."""
        return {
            name: int(self.word[at])
            for layout in layouts or self._layouts
            for at, (name, place) in zip(layout, places(type(layout)).items(), strict=True)
            if place.counted
        }
