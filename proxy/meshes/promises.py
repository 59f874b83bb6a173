"""What a mesh's file says of itself, where trimesh would read less than that without a word, or nothing.

A file that was cut off is a smaller mesh to trimesh, and a compressed one may be none. What is damaged otherwise
trimesh refuses itself. Each check raises ValueError in words.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Final

PLY_HEAD_MAX: Final = 1 << 16
"""Bytes of a PLY file before its numbers; scanners write some 500, with comments."""
_FACES: Final = re.compile(rb"^element\s+face\s+(\d+)\s*$", re.MULTILINE)


def ply(data: bytes) -> int:
    """A PLY file: how many faces its head promises."""
    if not data.startswith(b"ply"):
        raise ValueError(f"is no PLY file: it begins with {data[:8]!r}")
    head, mark, _ = data[:PLY_HEAD_MAX].partition(b"end_header")
    if not mark:
        raise ValueError(f"has no end_header within {PLY_HEAD_MAX:,} bytes: it was cut off, or is no PLY file")
    faces = _FACES.search(head)
    return int(faces[1]) if faces else 0


def stl(data: bytes) -> int:
    """An STL file: in binary its length goes by its triangles, as text it has an end."""
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if len(data) >= 84 and len(data) == 84 + 50 * count:
        return count
    if data[:5].lower() != b"solid" or b"facet" not in data[:4096].lower():
        there = f"says that it has {count:,} triangles, and has {max(0, len(data) - 84):,} bytes of 50 each for them"
        raise ValueError(f"{there}: it was cut off, or is no STL file")
    if b"endsolid" not in data[-4096:].lower():
        raise ValueError("has no endsolid at its end: it was cut off")
    return 0


def obj(data: bytes) -> int:
    """An OBJ file says nothing of itself."""
    return 0


def glb(data: bytes) -> int:
    """A GLB file: it is not compressed. Its first chunk is JSON, whose length is in bytes 12 to 15."""
    try:
        wanted = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")]).get("extensionsRequired", [])
    except (ValueError, AttributeError):
        return 0  # damaged, which trimesh says
    if packed := [name for name in wanted if "compression" in str(name)]:
        raise ValueError(f"is compressed ({packed[0]}): export it without compression")
    return 0


CHECKS: Final[dict[str, Callable[[bytes], int]]] = {"ply": ply, "stl": stl, "obj": obj, "glb": glb}
"""How the file of each ending is looked at first: how many faces it promises, 0 where it does not say."""
