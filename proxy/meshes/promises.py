"""What the head of a mesh's file promises, held against the bytes that are there, before a library believes it.

A few bytes can promise billions of triangles, or lead to other files. Each check raises ValueError in words.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, Final

from softfinger.config import limits

PLY_HEAD_MAX: Final = 1 << 16
"""Bytes of a PLY file before its numbers; scanners write some 500, with comments."""
GLB_HEAD_MAX: Final = 1 << 24
"""Bytes of the JSON in a GLB file, which takes some 20 times as much in memory."""
NODES_MAX: Final = 10_000
"""Of a GLB file's scene."""
COPIES_MAX: Final = 4
"""How often all bytes of a GLB file may be used: shared buffers could make gigabytes of a few."""

_TRIANGLES: Final = int(limits.MESH_TRIANGLES.high)
_PLY_BYTES: Final = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
_GLB_BYTES: Final = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_GLB_NUMBERS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def ply(data: bytes) -> int:
    """A PLY file: as many rows of each element as its head says find room in it."""
    if not data.startswith(b"ply"):
        raise ValueError(f"is no PLY file: it begins with {data[:8]!r}")
    head, mark, _ = data[:PLY_HEAD_MAX].partition(b"end_header")
    if not mark:
        raise ValueError(f"has no end_header within {PLY_HEAD_MAX:,} bytes: it was cut off, or is no PLY file")
    lines = [line.split() for line in head.decode("utf-8", "replace").splitlines()]
    text = any(line[:2] == ["format", "ascii"] for line in lines)
    rows: dict[str, int] = {}
    least: dict[str, int] = {}
    name = ""
    for line in lines:
        if line[:1] == ["element"] and len(line) == 3:
            name, rows[line[1]], least[line[1]] = line[1], _whole(line[2]), 0
        elif line[:1] == ["property"] and len(line) > 2 and name:
            # Of a list its length alone is certain. A number in text has a digit and what parts it from the next.
            least[name] += 2 if text else _PLY_BYTES.get(line[2] if line[1] == "list" else line[1], 1)
    needed, room = sum(rows[each] * least[each] for each in rows), len(data) - len(head) - len(mark)
    if needed > room + 1:  # the last line needs no end
        counts = ", ".join(f"{count:,} of {each}" for each, count in rows.items())
        raise ValueError(f"promises {counts}, and only {room:,} bytes follow: it was cut off, or is damaged")
    _check_count(rows.get("face", 0))
    return rows.get("face", 0)


def stl(data: bytes) -> int:
    """An STL file: in binary its length goes by its triangles, as text it has an end."""
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if len(data) >= 84 and len(data) == 84 + 50 * count:
        _check_count(count)
        return count
    if data[:5].lower() != b"solid" or b"facet" not in data[:4096].lower():
        there = f"says that it has {count:,} triangles, and has {max(0, len(data) - 84):,} bytes of 50 each for them"
        raise ValueError(f"{there}: it was cut off, or is no STL file")
    if b"endsolid" not in data[-4096:].lower():
        raise ValueError("has no endsolid at its end: it was cut off")
    _check_count(data.lower().count(b"endfacet"))
    return 0


def obj(data: bytes) -> int:
    """An OBJ file: text, with vertices and faces."""
    if b"\0" in data:
        raise ValueError("is no OBJ file: that is text, and this is not")
    if data[:2] not in (b"v ", b"v\t") and b"\nv " not in data and b"\nv\t" not in data:
        raise ValueError("is no OBJ file: it has no line of a vertex, such as v 0 0 0")
    _check_count(data.count(b"\nf"))
    return 0


def glb(data: bytes) -> int:
    """A GLB file: all that its meshes are made of is in it, each node is there once, and what they make has an end."""
    if data[:4] != b"glTF":
        raise ValueError(f"is no GLB file: it begins with {data[:8]!r}")
    size, length = (int.from_bytes(data[at : at + 4], "little") for at in (8, 12))
    if size > len(data) or 20 + length > len(data):
        raise ValueError(f"says that it has {max(size, 20 + length):,} bytes, and has {len(data):,}: it was cut off")
    if length > GLB_HEAD_MAX:
        raise ValueError(f"has {length:,} bytes of JSON: {GLB_HEAD_MAX:,} are the most that are read")
    head = json.loads(data[20 : 20 + length])
    try:
        _check_glb(head, len(data))
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(f"does not describe its meshes as glTF has it: {type(error).__name__} {error}") from error
    return 0


def _check_glb(head: dict[str, Any], size: int) -> None:
    if packed := [name for name in head.get("extensionsRequired", []) if "compression" in name or "draco" in name]:
        raise ValueError(f"is compressed ({packed[0]}): export it without compression")
    if outside := [each["uri"] for each in head.get("buffers", []) if not each.get("uri", "data:").startswith("data:")]:
        raise ValueError(f"has its numbers in another file, {outside[0][:80]!r}: export it as one file")
    accessors = head.get("accessors", [])
    used = sum(_natural(view["byteLength"]) for view in head.get("bufferViews", []))
    used += sum(
        _natural(each["count"]) * _GLB_BYTES[each["componentType"]] * _GLB_NUMBERS[each["type"]] for each in accessors
    )
    if used > COPIES_MAX * size:
        raise ValueError(f"promises {used:,} bytes of numbers, and has {size:,}: it is damaged")
    triangles = [
        sum(_corners(part, accessors) for part in mesh["primitives"]) // 3 + 1 for mesh in head.get("meshes", [])
    ]
    nodes = head.get("nodes", [])
    if len(nodes) > NODES_MAX:
        raise ValueError(f"has {len(nodes):,} nodes, {NODES_MAX:,} are the most: join them")
    below = [child for node in nodes for child in node.get("children", [])]
    if len(set(below)) < len(below):
        raise ValueError("has a node below two others, or below one twice: glTF has it below one")
    _check_count(sum(triangles))
    _check_count(sum(triangles[node["mesh"]] for node in nodes if "mesh" in node))


def _corners(part: dict[str, Any], accessors: list[Any]) -> int:
    """Of the triangles of a primitive, at most; of a strip three times as many as it has."""
    count = _natural(accessors[part.get("indices", part["attributes"].get("POSITION"))]["count"])
    return 3 * count if part.get("mode", 4) == 5 else count


def _natural(number: Any) -> int:
    if not isinstance(number, int) or number < 0:
        raise TypeError(f"{number!r} is no count")
    return number


def _whole(text: str) -> int:
    if not text.isdecimal() or len(text) > 18:
        raise ValueError(f"promises {text[:40]!r} rows: that is no count")
    return int(text)


def _check_count(triangles: int) -> None:
    if triangles > _TRIANGLES:
        raise ValueError(f"has {triangles:,} triangles, {_TRIANGLES:,} are the most: decimate it")


CHECKS: Final[dict[str, Callable[[bytes], int]]] = {"ply": ply, "stl": stl, "obj": obj, "glb": glb}
"""How the file of each ending is looked at first: how many faces it promises, 0 where it does not say."""
