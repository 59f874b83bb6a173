"""Ticks as rows of numbers and as encoded messages, whole blocks at a time.

All numbers of a tick have eight bytes, so every message of a kind is the same template with other numbers in it. The
template is made by the protobuf library from marker values; then a block of messages is one array of bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import FIELDS, columns
from softfinger.server.recording.schemas import TICK, message_class

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_ORDER: Final = {field.name: place for place, field in enumerate(FIELDS)}

COLUMNS_MAX: Final = 4096
"""Numbers of a tick in a file; this program's have some hundred."""


class Part(NamedTuple):
    """A field: dotted name, number of components, whether it is an integer, its first column."""

    name: str
    size: int
    whole: bool
    at: int


class Layout:
    """Where each number stands in an encoded message.

    message  an instance whose repeated fields have the length that all have; what it holds is overwritten. ValueError
             where it holds anything but numbers of eight bytes.
    """

    def __init__(self, message: Any) -> None:
        walked = list(self._walked(message, "", 0))
        encoded = message.SerializeToString(deterministic=True)
        parts, at, column = [], list[int](), 0
        # In the order of a record, whatever the order in the message; what no record has comes behind.
        for part in sorted(walked, key=lambda part: _ORDER.get(part.name, len(_ORDER))):
            at += [encoded.index(_marker_bytes(part.at + i, part.whole)) for i in range(part.size)]
            parts.append(part._replace(at=column))
            column += part.size
        self.parts: Final = parts
        self.width: Final = column
        self._whole = np.repeat([part.whole for part in parts], [part.size for part in parts])
        # Numbers side by side are copied as one piece: (bytes, where in a row, where in a message).
        starts = [0, *(i for i in range(1, self.width) if at[i] != at[i - 1] + 8), self.width]
        pieces = [(8 * (b - a), 8 * a, at[a]) for a, b in pairwise(starts)]
        self._row = _cut(8 * self.width, [(size, row) for size, row, _ in pieces])
        self._message = _cut(len(encoded), [(size, place) for size, _, place in pieces])
        self._template = np.frombuffer(encoded, dtype=np.uint8)
        fixed = np.ones(len(encoded), dtype=bool)
        for size, _, first in pieces:
            fixed[first : first + size] = False
        self._fixed = np.flatnonzero(fixed)

    @property
    def size(self) -> int:
        """Bytes of a message."""
        return len(self._template)

    def encode(self, rows: Array, out: Bytes) -> None:
        """Put messages of rows (n, width) into `out` (n, size). ValueError where an integer's is no whole number."""
        values = np.array(rows, dtype="<f8")
        counts = values[:, self._whole]
        with np.errstate(invalid="ignore"):
            whole = counts.astype("<i8")
        if not np.array_equal(whole, counts):
            row, column = (int(i) for i in np.argwhere(whole != counts)[0])
            name = columns()[int(np.flatnonzero(self._whole)[column])]
            raise ValueError(f"record {row}: {name} = {counts[row, column]}, must be a whole number")
        values[:, self._whole] = whole.view("<f8")  # the bit pattern of the integer
        out[:] = self._template
        out.view(self._message)[:] = values.view(self._row)

    def decode(self, messages: Bytes) -> Array | None:
        """Rows (n, width) of messages (n, size); None where one of them has another layout."""
        if not np.array_equal(messages[:, self._fixed], np.broadcast_to(
            self._template[self._fixed], (len(messages), len(self._fixed))
        )):  # fmt: skip
            return None
        rows = np.empty((len(messages), self.width), "<f8")
        rows.view(self._row)[:] = messages.view(self._message)
        rows[:, self._whole] = rows[:, self._whole].view("<i8")
        return rows

    def row(self, message: Any) -> list[float]:
        """The numbers of one decoded message; ValueError where it has others."""
        values: list[float] = []
        for part in self.parts:
            value = message
            for name in part.name.split("."):
                value = getattr(value, name)
            values.extend(value if part.size > 1 else (value,))
        if len(values) != self.width:
            raise ValueError(f"a message of {len(values)} numbers, must be {self.width}")
        return values

    def _walked(self, message: Any, prefix: str, at: int) -> Iterator[Part]:
        for field in message.DESCRIPTOR.fields:
            inner = getattr(message, field.name)
            if field.type == field.TYPE_MESSAGE and not field.is_repeated:
                for part in self._walked(inner, f"{prefix}{field.name}.", at):
                    yield part
                    at += part.size
                continue
            if field.type not in (field.TYPE_DOUBLE, field.TYPE_SFIXED64):
                raise ValueError(f"{prefix}{field.name} is no number of eight bytes")
            whole = field.type == field.TYPE_SFIXED64
            size = len(inner) if field.is_repeated else 1
            if at + size > COLUMNS_MAX:
                raise ValueError(f"more than {COLUMNS_MAX} numbers in a message")
            if size:
                markers: list[Any] = [_marker(at + i) for i in range(size)]
                markers = [int(marker) for marker in markers] if whole else markers
                if field.is_repeated:
                    inner[:] = markers
                else:
                    setattr(message, field.name, markers[0])
                yield Part(f"{prefix}{field.name}", size, whole, at)
                at += size


@cache
def tick_layout() -> Layout:
    """The layout of this version's ticks: its columns are those of a record."""
    message = message_class(TICK)()
    for field in FIELDS:
        if field.size > 1:
            *parents, leaf = field.name.split(".")
            owner = message
            for parent in parents:
                owner = getattr(owner, parent)
            getattr(owner, leaf).extend([0] * field.size)
    return Layout(message)


def _cut(size: int, pieces: Sequence[tuple[int, int]]) -> np.dtype[np.void]:
    """So many bytes, seen as pieces: the size of each and where it begins."""
    return np.dtype(
        {
            "names": [str(number) for number in range(len(pieces))],
            "formats": [f"V{length}" for length, _ in pieces],
            "offsets": [first for _, first in pieces],
            "itemsize": size,
        }
    )


def _marker(number: int) -> float:
    """A number found nowhere else in an encoded message, exact as float64 and as integer."""
    return float(0x5AA5_3CC3_0000 + 0x0101 * (number + 1))


def _marker_bytes(number: int, whole: bool) -> bytes:
    return np.array(_marker(number), dtype="<i8" if whole else "<f8").tobytes()
