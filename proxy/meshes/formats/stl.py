"""STL, binary and text. Programs write white space or zeros behind the end, and "solid" in front of binary files."""

from __future__ import annotations

import re
from itertools import chain
from typing import Final

import numpy as np

from softfinger.proxy.meshes.formats.polygons import Faces, require_triangles
from softfinger.proxy.meshes.formats.text import clean, iter_blocks, parse_numbers

HEAD: Final = 84
"""Bytes of a binary file before its triangles."""
_TRIANGLE: Final = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET: Final = re.compile(
    rb"\bfacet(?:\s+normal\s+\S+\s+\S+\s+\S+)?\s+outer\s+loop"
    + 3 * rb"\s+vertex\s+(\S+\s+\S+\s+\S+)"
    + rb"\s+endloop\s+endfacet\b",
    re.IGNORECASE,
)

_FACET_END: Final = re.compile(rb"\bendfacet\b", re.IGNORECASE)


def read(data: bytes) -> Faces:
    """Return the triangles of an STL file, without shared corners."""
    count = int.from_bytes(data[80:84], "little") if len(data) >= HEAD else 0
    end = HEAD + _TRIANGLE.itemsize * count
    if len(data) >= end:  # a text has a count beyond its length there
        if behind := data[end:].strip(b"\0 \t\r\n\x1a"):
            raise ValueError(
                f"states {count:,} triangles, but {len(behind):,} bytes follow them: it is damaged, or has "
                "several solids; export it as one"
            )
        return _read_faces(np.frombuffer(data, _TRIANGLE, count, HEAD)["corners"].astype(np.float64), count)
    text = clean(data).strip(b"\0 \t\n\x1a")
    if text[:5].lower() != b"solid" or b"\0" in text:
        if not data.strip():
            raise ValueError("is empty")
        fault = f"states {count:,} triangles, but has {len(data) - HEAD:,} bytes of 50 each for them"
        if len(data) < HEAD:
            fault = f"has {len(data)} bytes, fewer than the head of an STL file"
        raise ValueError(f"{fault}: it is truncated or not an STL file")
    if b"endsolid" not in text[text.rfind(b"\n") + 1 :].lower() and b"endsolid" not in text[-4096:].lower():
        raise ValueError("has no endsolid at its end: it is truncated")
    facets = (_FACET.findall(text, *block) for block in iter_blocks(text, _FACET_END))
    corners = parse_numbers(b" ".join(b" ".join(chain.from_iterable(found)) for found in facets), np.float64)
    return _read_faces(corners, text.lower().count(b"endfacet"))  # a quarter of the time of a search for whole words


def _read_faces(corners: np.ndarray, promised: int) -> Faces:
    points = corners.reshape(-1, 3)
    return require_triangles(points, np.arange(len(points)).reshape(-1, 3), promised)
