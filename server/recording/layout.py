"""Conversion of ticks between rows of numbers and encoded messages, in blocks.

All numbers of a tick have eight bytes, so messages of one type differ only in their numbers. The protobuf library
encodes a template with marker values once. Copying numbers to the marked offsets then gives a block of messages.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.proxy.record import FIELDS, list_columns
from softfinger.server.recording.schemas import TICK, make_message_class

Bytes = NDArray[np.uint8]

_ORDER: Final = {field.name: index for index, field in enumerate(FIELDS)}

COLUMNS_MAX: Final = 4096
"""Maximum of numbers per tick in a file; ticks of this program have about a hundred."""


class TickField(NamedTuple):
    """Field: dotted name, number of components, whether it is an integer, first column."""

    name: str
    size: int
    is_integer: bool
    at: int


class Layout:
    """Byte offset of each number in an encoded message.

    message  instance whose repeated fields have the length common to all messages; its values are overwritten

    Raises ValueError if a field is not a number of eight bytes.
    """

    def __init__(self, message: Any) -> None:
        fields = list(self._walk_fields(message, "", 0))
        encoded = message.SerializeToString(deterministic=True)
        parts, at, column = [], list[int](), 0
        # Sort by the order of a record, which the message may not have; unknown fields follow.
        for part in sorted(fields, key=lambda part: _ORDER.get(part.name, len(_ORDER))):
            kind = "<i8" if part.is_integer else "<f8"
            at += [encoded.index(np.array(_make_marker(part.at + i), kind).tobytes()) for i in range(part.size)]
            parts.append(part._replace(at=column))
            column += part.size
        self.parts: Final = parts
        self.width: Final = column
        self._integer_columns = np.repeat([part.is_integer for part in parts], [part.size for part in parts])
        # Adjacent numbers are copied as one piece: (bytes, offset in a row, offset in a message).
        starts = [0, *(i for i in range(1, self.width) if at[i] != at[i - 1] + 8), self.width]
        pieces = [(8 * (b - a), 8 * a, at[a]) for a, b in pairwise(starts)]
        self._row = _make_piece_dtype(8 * self.width, [(size, row) for size, row, _ in pieces])
        self._message = _make_piece_dtype(len(encoded), [(size, offset) for size, _, offset in pieces])
        self._template = np.frombuffer(encoded, dtype=np.uint8)
        self.size: Final = len(encoded)
        fixed = np.ones(len(encoded), dtype=bool)
        for size, _, first in pieces:
            fixed[first : first + size] = False
        self._fixed = np.flatnonzero(fixed)

    def encode(self, rows: Array, out: Bytes) -> None:
        """Encode rows (n, width) into `out` (n, size); raises ValueError if an integer field has a fraction."""
        values = np.array(rows, dtype="<f8")
        counts = values[:, self._integer_columns]
        with np.errstate(invalid="ignore"):
            integers = counts.astype("<i8")
        if not np.array_equal(integers, counts):
            row, column = (int(i) for i in np.argwhere(integers != counts)[0])
            name = list_columns()[int(np.flatnonzero(self._integer_columns)[column])]
            raise ValueError(f"record {row}: {name} = {counts[row, column]}, must be an integer")
        values[:, self._integer_columns] = integers.view("<f8")  # the bit pattern of the integer
        out[:] = self._template
        out.view(self._message)[:] = values.view(self._row)

    def decode(self, messages: Bytes) -> Array | None:
        """Return rows (n, width) of messages (n, size); None if a message has another layout."""
        if not np.array_equal(messages[:, self._fixed], np.broadcast_to(
            self._template[self._fixed], (len(messages), len(self._fixed))
        )):  # fmt: skip
            return None
        rows = np.empty((len(messages), self.width), "<f8")
        rows.view(self._row)[:] = messages.view(self._message)
        rows[:, self._integer_columns] = rows[:, self._integer_columns].view("<i8")
        return rows

    def row(self, message: Any) -> list[float]:
        """Return the numbers of one decoded message; raises ValueError if their count differs from the layout's."""
        values: list[float] = []
        for part in self.parts:
            value = message
            for name in part.name.split("."):
                value = getattr(value, name)
            values.extend(value if part.size > 1 else (value,))
        if len(values) != self.width:
            raise ValueError(f"a message of {len(values)} numbers, must be {self.width}")
        return values

    def _walk_fields(self, message: Any, prefix: str, at: int) -> Iterator[TickField]:
        for field in message.DESCRIPTOR.fields:
            inner = getattr(message, field.name)
            if field.type == field.TYPE_MESSAGE and not field.is_repeated:
                for part in self._walk_fields(inner, f"{prefix}{field.name}.", at):
                    yield part
                    at += part.size
                continue
            if field.type not in (field.TYPE_DOUBLE, field.TYPE_SFIXED64):
                raise ValueError(f"{prefix}{field.name} is not a number of eight bytes")
            is_integer = field.type == field.TYPE_SFIXED64
            size = len(inner) if field.is_repeated else 1
            if at + size > COLUMNS_MAX:
                raise ValueError(f"more than {COLUMNS_MAX} numbers in a message")
            if size:
                markers: list[Any] = [_make_marker(at + i) for i in range(size)]
                markers = [int(marker) for marker in markers] if is_integer else markers
                if field.is_repeated:
                    inner[:] = markers
                else:
                    setattr(message, field.name, markers[0])
                yield TickField(f"{prefix}{field.name}", size, is_integer, at)
                at += size


@cache
def make_tick_layout() -> Layout:
    """Return the layout of this version's ticks, with the columns of a record."""
    message = make_message_class(TICK)()
    for field in FIELDS:
        if field.size > 1:
            *parents, leaf = field.name.split(".")
            owner = message
            for parent in parents:
                owner = getattr(owner, parent)
            getattr(owner, leaf).extend([0] * field.size)
    return Layout(message)


def _make_piece_dtype(size: int, pieces: Sequence[tuple[int, int]]) -> np.dtype[np.void]:
    """Return a type that splits `size` bytes into pieces, each given by its length and offset."""
    return np.dtype(
        {
            "names": [str(number) for number in range(len(pieces))],
            "formats": [f"V{length}" for length, _ in pieces],
            "offsets": [first for _, first in pieces],
            "itemsize": size,
        }
    )


def _make_marker(number: int) -> float:
    """Return a number that occurs only once in an encoded message and is exact as float64 and as integer."""
    return float(0x5AA5_3CC3_0000 + 0x0101 * (number + 1))
