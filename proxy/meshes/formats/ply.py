"""PLY, text and binary: vertices, faces of any number of corners, and triangle strips."""

from __future__ import annotations

import re
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.meshes.formats.polygons import Faces, Indices, require_triangles, split_strip
from softfinger.proxy.meshes.formats.text import parse_numbers

HEAD_MAX: Final = 1 << 16
"""Bytes of a head; scanners write some 500, with comments."""
_KINDS: Final = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES: Final = {name: kind for kind, names in _KINDS.items() for name in names}
_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END: Final = re.compile(rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r)")
_LISTS: Final = ("vertex_indices", "vertex_index")


class Property(NamedTuple):
    """A number of the type `kind` in each row, or a list of them with its length, of the type `length`, in front."""

    name: str
    kind: str
    length: str | None


class Element(NamedTuple):
    """A table of the file: its name, its number of rows, and their properties."""

    name: str
    rows: int
    properties: list[Property]


class Column(NamedTuple):
    """Values of a property in all rows, one after the other, and how many of them each row has."""

    values: NDArray[Any]
    counts: Indices


Table = dict[str, Column]


def read(data: bytes) -> Faces:
    """Return the faces of a PLY file, or the triangles of its strips."""
    order, elements, body = _read_head(data)
    is_text = order == ""
    if is_text:  # from here on a text is a binary file of float64
        body, order = parse_numbers(body.rstrip(b"\0"), np.float64).astype("<f8").tobytes(), "<"
        elements = [entry._replace(properties=list(map(_as_float64, entry.properties))) for entry in elements]
    at, tables, rows = 0, dict[str, Table](), dict[str, int]()
    for element in elements:
        rows[element.name] = element.rows
        tables[element.name], at = _read_rows(element, body, at, order)
    if behind := body[at:].strip(b"\0 \t\r\n"):
        rest = f"{(len(body) - at) // 8:,} numbers" if is_text else f"{len(behind):,} bytes"
        raise ValueError(f"has other rows than its header declares: {rest} are unused")
    if not rows.get("vertex"):
        return Faces(np.empty((0, 3)), np.empty(0, np.int64), np.empty(0, np.int64), 0)
    points = np.stack([_read_scalar(tables, axis) for axis in "xyz"], axis=1)
    if not rows.get("tristrips"):
        empty = Column(np.empty(0, np.int64), np.empty(0, np.int64))
        corners, counts = _read_corners(tables["face"]) if rows.get("face") else empty
        return Faces(points, corners, counts, rows.get("face", 0))
    if rows.get("face"):
        raise ValueError("has faces and triangle strips: export it with faces only")
    strips, counts = _read_corners(tables["tristrips"])
    parts = [split_strip(part) for row in np.split(strips, np.cumsum(counts)[:-1]) for part in _cut(row)]
    triangles = np.concatenate(parts)
    return require_triangles(points, triangles, len(triangles))


def _read_head(data: bytes) -> tuple[str, list[Element], bytes]:
    """Return the byte order, empty for text, the elements, and the bytes after the head."""
    if not data.startswith(b"ply"):
        raise ValueError(f"is not a PLY file: it starts with {data[:8]!r}")
    end = _END.search(data, 0, HEAD_MAX)
    if end is None:
        raise ValueError(f"has no end_header within {HEAD_MAX:,} bytes: it is truncated or not a PLY file")
    elements, encoding = list[Element](), ""
    for line in data[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", str(encoding), _] if encoding in _ORDERS:
                pass
            case ["element", name, rows] if rows.isdecimal() and len(rows) < 16:
                elements.append(Element(name, int(rows), []))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= _TYPES.keys():
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[count]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(Property(name, _TYPES[kind], None))
            case ["element" | "property" | "format", *_]:
                raise ValueError(f"is damaged or not a PLY file: its header has {line.strip()[:60]!r}")
    if encoding not in _ORDERS:
        raise ValueError(f"is damaged or not a PLY file: its header has no format of {', '.join(_ORDERS)}")
    return _ORDERS[encoding], elements, data[end.end() :]


def _as_float64(column: Property) -> Property:
    return column._replace(kind="f8", length=None if column.length is None else "f8")


def _read_rows(element: Element, body: bytes, at: int, order: str) -> tuple[Table, int]:
    """Return the values of all rows, which begin at byte `at`, and the place of their end."""
    if not element.rows or not element.properties:
        return {}, at
    table = _read_equal_rows(element, body, at, order)
    return _read_unequal_rows(element, body, at, order) if table is None else table


def _read_equal_rows(element: Element, body: bytes, at: int, order: str) -> tuple[Table, int] | None:
    """Read rows with lists as long as in the first row; None if one differs or the file is too short."""
    place, fields, lengths = at, list[Any](), list[int]()
    for number, column in enumerate(element.properties):
        length = 1 if column.length is None else _count(body, place, order + column.length)
        if column.length is not None:
            fields.append((f"count {number}", order + column.length))
            place += int(column.length[1])
        fields.append((f"{number}", order + column.kind, (length,)))
        lengths.append(length)
        place += length * int(column.kind[1])
        if place > len(body):
            return None
    row = np.dtype(fields)
    if element.rows * row.itemsize > len(body) - at:
        return None
    block, table = np.frombuffer(body, row, element.rows, at), dict[str, Column]()
    for number, (column, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if column.length is not None and (block[f"count {number}"] != length).any():
            return None
        table[column.name] = Column(block[f"{number}"].reshape(-1), np.full(element.rows, length, np.int64))
    return table, at + element.rows * row.itemsize


def _read_unequal_rows(element: Element, body: bytes, at: int, order: str) -> tuple[Table, int]:
    """Read rows with lists of different lengths. Raises ValueError if the file ends in one of them."""
    properties = [(column, int(column.kind[1]), int((column.length or "_0")[1])) for column in element.properties]
    least = sum(count_size or size for _, size, count_size in properties)
    starts, counts = np.empty((2, len(properties), min(element.rows, (len(body) - at) // least + 1)), np.int64)
    for row in range(element.rows):
        for number, (column, size, count_size) in enumerate(properties):
            count = 1 if column.length is None else _count(body, at, order + column.length)
            at += count_size
            if at + count * size > len(body):
                fault = f"declares {element.rows:,} entries of {element.name}, but has {row:,}"
                raise ValueError(f"{fault}: it is truncated or damaged")
            starts[number, row], counts[number, row] = at, count
            at += count * size
    codes, table = np.frombuffer(body, np.uint8), dict[str, Column]()
    for (column, size, _), start, count in zip(properties, starts, counts, strict=True):
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        first = np.repeat(start, count) + size * within
        table[column.name] = Column(codes[first[:, None] + np.arange(size)].view(order + column.kind)[:, 0], count)
    return table, at


def _count(body: bytes, at: int, kind: str) -> int:
    """Return the length of a list. Raises ValueError if it is none."""
    data = body[at : at + int(kind[2])]
    count = float(np.frombuffer(data, kind)[0]) if len(data) == int(kind[2]) else 0.0
    if not 0.0 <= count <= len(body):
        raise ValueError(f"is damaged: a list has {count:g} entries")
    return int(count)


def _read_scalar(tables: dict[str, Table], name: str) -> NDArray[np.float64]:
    column = tables.get("vertex", {}).get(name)
    if column is None or (column.counts != 1).any():
        raise ValueError(f"is damaged or no mesh: its vertices have no {name}")
    return column.values.astype(np.float64)


def _read_corners(table: Table) -> Column:
    corners = next((table[name] for name in _LISTS if name in table), None)
    if corners is None:
        raise ValueError(f"has faces without {_LISTS[0]}; they have {', '.join(table) or 'nothing'}")
    if not (corners.values == np.trunc(corners.values)).all():
        raise ValueError("is damaged: a face has a vertex index that is not an integer")
    with np.errstate(invalid="ignore"):  # a number too large is out of range afterwards, too
        return corners._replace(values=corners.values.astype(np.int64))


def _cut(row: Indices) -> list[Indices]:
    """Return the strips between the entries -1 of a row."""
    return [part[part != -1] for part in np.split(row, np.flatnonzero(row == -1))]
