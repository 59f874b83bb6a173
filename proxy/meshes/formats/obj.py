"""Wavefront OBJ: vertices and faces of all groups; normals, texture coordinates and materials are skipped."""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from softfinger.proxy.meshes.formats.polygons import Faces, Indices, Points
from softfinger.proxy.meshes.formats.text import (
    clean,
    count_words_per_line,
    find_in_lines,
    parse_numbers,
    remove_in_lines,
)

_VERTEX: Final = re.compile(rb"^[ \t]*v[ \t]+([^\n]*)", re.MULTILINE)
_FACE: Final = re.compile(rb"^[ \t]*fo?[ \t]+([^\n]*)", re.MULTILINE)
_REFUSED: Final = re.compile(rb"^[ \t]*(surf|curv2?|call|csh)[ \t]", re.MULTILINE)
_REASONS: Final = {b"call": "stores its numbers in another file", b"csh": "calls a program"}


def read(data: bytes) -> Faces:
    """Return the faces of an OBJ file. Raises ValueError for free-form surfaces and for numbers in other files."""
    text = clean(data)
    if b"\\\n" in text:  # a continued line
        text = text.replace(b"\\\n", b" ")
    if b"#" in text:
        text = remove_in_lines(rb"#[^\n]*", text)
    if refused := find_in_lines(_REFUSED, text):
        name = refused.partition(b"\n")[0]
        reason = _REASONS.get(name, "has free-form surfaces")
        raise ValueError(f"{reason} ({name.decode()}): export it as triangles in one file")
    points = _parse_points(find_in_lines(_VERTEX, text))
    rows = find_in_lines(_FACE, text)
    if b"/" in rows:
        rows = remove_in_lines(rb"/[^\s]*", rows)
    if not rows:
        return Faces(points, np.empty(0, np.int64), np.empty(0, np.int64), 0)
    counts = count_words_per_line(rows)
    corners = parse_numbers(rows, np.int64)
    if len(corners) != counts.sum():
        raise ValueError(f"is damaged: {counts.sum():,} corners of faces, and {len(corners):,} numbers for them")
    return Faces(points, _to_zero_based(text, corners, counts, len(points)), counts, len(counts))


def _parse_points(text: bytes) -> Points:
    """Return the coordinates (n, 3) in lines of x y z, with a weight or a colour behind them, or not."""
    values, words = parse_numbers(text, np.float64), count_words_per_line(text) if text else np.empty(0, np.int64)
    if (words == 3).all():
        return values.reshape(-1, 3)
    if (words < 3).any():
        bad = int((words < 3).argmax())
        raise ValueError(f"is damaged: vertex {bad + 1} has {words[bad]} coordinates, must have three coordinates")
    return np.asarray(values[(np.cumsum(words) - words)[:, None] + np.arange(3)])


def _to_zero_based(text: bytes, corners: Indices, counts: Indices, count: int) -> Indices:
    """Return the corners as indices from 0; in the file they count from 1, or back from the last vertex if negative.

    count  vertices of the file
    """
    missing = (corners == 0) | (corners > count)
    if missing.any():
        bad = int(missing.argmax())
        face = int(np.searchsorted(np.cumsum(counts), bad, side="right"))
        raise ValueError(f"is damaged: face {face + 1} has the vertex {corners[bad]}, but there are 1 to {count:,}")
    if (corners > 0).all():
        return corners - 1
    vertices, faces = (np.array([match.start() for match in kind.finditer(text)]) for kind in (_VERTEX, _FACE))
    before = np.repeat(np.searchsorted(vertices, faces), counts)
    relative = np.where(corners < 0, before + corners, corners - 1)
    if (relative < 0).any():
        bad = int((relative < 0).argmax())
        raise ValueError(f"is damaged: a face has the vertex {corners[bad]} with only {before[bad]:,} before it")
    return relative
