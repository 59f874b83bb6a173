"""Checks of a mesh file that trimesh would read incompletely without an error.

trimesh reads a truncated file as a smaller mesh, and a compressed one possibly as none. It rejects other damage itself.
Each check raises ValueError with the fault.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Final

PLY_HEAD_MAX: Final = 1 << 16
"""Limit of the header of a PLY file, bytes; scanners write about 500, with comments."""
_FACES: Final = re.compile(rb"^element\s+face\s+(\d+)\s*$", re.MULTILINE)


def ply(data: bytes) -> int:
    """Return the number of faces that the header of a PLY file declares; 0 without a face element."""
    if not data.startswith(b"ply"):
        raise ValueError(f"is no PLY file: it begins with {data[:8]!r}")
    head, mark, _ = data[:PLY_HEAD_MAX].partition(b"end_header")
    if not mark:
        raise ValueError(f"has no end_header within {PLY_HEAD_MAX:,} bytes: it was cut off, or is no PLY file")
    faces = _FACES.search(head)
    return int(faces[1]) if faces else 0


def stl(data: bytes) -> int:
    """Check that an STL file is complete, and return its number of triangles; 0 for a text file.

    The length of a binary file follows from its number of triangles; a text file has an end marker.
    """
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
    """Return 0: an OBJ file does not declare its number of faces."""
    return 0


def glb(data: bytes) -> int:
    """Check that a GLB file is not compressed, and return 0. Bytes 12 to 15 are the length of its first chunk, JSON."""
    try:
        wanted = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")]).get("extensionsRequired", [])
    except (ValueError, AttributeError):
        return 0  # damaged; trimesh reports it
    if packed := [name for name in wanted if "compression" in str(name)]:
        raise ValueError(f"is compressed ({packed[0]}): export it without compression")
    return 0


CHECKS: Final[dict[str, Callable[[bytes], int]]] = {"ply": ply, "stl": stl, "obj": obj, "glb": glb}
"""Check of each file ending; returns the number of faces that the file declares, 0 if it declares none."""
