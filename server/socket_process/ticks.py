"""Reader of ticks in shared memory, without numpy; `process.py` uses it.

docs/protocol.md describes the layout, and `softfinger_ring.h` is the same reader in C.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from typing import Final

_CAPACITY: Final = 2
_WIDTH: Final = 3
_HEAD: Final = 8
_PAGE_BYTES: Final = 4096


class RowReader:
    """Reader that starts at row `begin` and takes ownership of the file; `bell` is an eventfd that signals new rows."""

    def __init__(self, file: int, begin: int, bell: int) -> None:
        self._memory = mmap.mmap(file, 0, prot=mmap.PROT_READ)
        os.close(file)
        self._words = memoryview(self._memory).cast("q")
        self._capacity, width = self._words[_CAPACITY], self._words[_WIDTH]
        self._row = struct.Struct(f"{width}d")
        self._next, self.bell = begin, bell
        self.lost = 0
        """Rows that were overwritten before they were read."""

    def take(self) -> Iterator[tuple[float, ...]]:
        """Yield every available row, oldest first; skip to the middle of the ring if a full ring behind."""
        head = self._words[_HEAD]
        while self._next < head:
            if head - self._next >= self._capacity:
                to = head - self._capacity // 2
                self.lost += to - self._next
                self._next = to
            slot = self._next & (self._capacity - 1)
            row = self._row.unpack_from(self._memory, _PAGE_BYTES + slot * self._row.size)
            head = self._words[_HEAD]
            if head - self._next < self._capacity:  # it was not overwritten during the copy
                self._next += 1
                yield row
