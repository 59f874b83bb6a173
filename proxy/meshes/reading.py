"""Triangles of a mesh file, as they are in it: in one piece, in its unit, with no other file opened."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.proxy.meshes.formats import glb, obj, ply, stl
from softfinger.proxy.meshes.formats.polygons import Faces, triangulate

Vertices = NDArray[np.float64]
Triangles = NDArray[np.int32]

BYTES_MAX: Final = int(limits.MESH_BYTES.high)
READERS: Final[dict[str, Callable[[bytes], Faces]]] = {
    "ply": ply.read,
    "stl": stl.read,
    "obj": obj.read,
    "glb": glb.read,
}
"""Reader of the files of each ending."""
OTHER_FILES: Final = {
    b"version https://git-lfs": "is a pointer of Git LFS and not the file: get it with `git lfs pull`",
    b"\x1f\x8b": "is compressed (gzip): unpack it",
    b"PK\x03\x04": "is compressed (zip): unpack it",
}
"""Reason to refuse a file of another kind, by its first bytes."""
TETRAHEDRA: Final = ("msh", "vtu")
"""Endings of the files of elastic bodies that `proxy/elastic/volume.py` reads."""
_REASON_MAX: Final = 200
"""Characters of an exception's text in a message."""


class Arrays(NamedTuple):
    """vertices (n, 3) float64, in the file's unit or m; triangles (m, 3) int32, indices of vertices."""

    vertices: Vertices
    triangles: Triangles


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a mesh file. Raises ConfigError if it is missing, too large, or of an unknown ending."""
    if _find_kind(path) not in (*READERS, *TETRAHEDRA):
        raise ConfigError(
            f"{path}: must be one of {', '.join(f'.{kind}' for kind in READERS)}: export it as one of these"
        )
    try:
        return read_input(path, BYTES_MAX)
    except (OSError, MemoryError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ConfigError(f"{path}: cannot be read: {reason}") from error


def parse_mesh(path: str | Path, data: bytes) -> Arrays:
    """Return the triangles in the bytes of a mesh file; its ending selects the format.

    Raises ConfigError with file and fault, also if the file has another number of faces than it states.
    """
    kind = _find_kind(path)
    for start, reason in OTHER_FILES.items():
        if data.startswith(start):
            raise ConfigError(f"{path}: {reason}")
    try:
        faces = READERS[kind](data)
        _check(faces)
        triangles = triangulate(faces)
    except ValueError as error:
        raise ConfigError(f"{path}: {_format_error(error)}") from error
    except Exception as error:  # damaged bytes fail in many ways
        raise ConfigError(f"{path}: is damaged or not a {kind.upper()} file: {_format_error(error)}") from error
    return Arrays(np.ascontiguousarray(faces.points), np.ascontiguousarray(triangles, dtype=np.int32))


def _find_kind(path: str | Path) -> str:
    return Path(path).suffix.lower().removeprefix(".")


def _check(faces: Faces) -> None:
    points, corners, counts, promised = faces
    if len(counts) != promised:
        raise ValueError(f"declares {promised:,} faces, but has {len(counts):,}: it is truncated or damaged")
    if len(counts) == 0:
        raise ValueError("has no triangles: it is damaged or has only points: mesh them first")
    triangles = int(np.maximum(counts - 2, counts > 0).sum())
    if triangles > limits.MESH_TRIANGLES.high:
        raise ValueError(f"has {triangles:,} triangles, {limits.MESH_TRIANGLES.high:,} are the limit: decimate it")
    if not (corners.min(initial=0) >= 0 and corners.max(initial=0) < len(points)):
        bad = int(((corners < 0) | (corners >= len(points))).argmax())
        face = int(np.searchsorted(np.cumsum(counts), bad, side="right"))
        raise ValueError(f"face {face} has the corner {corners[bad]}, but there are vertices 0 to {len(points) - 1}")
    if not np.isfinite(points).all():
        bad = int(np.isfinite(points).all(axis=1).argmin())
        x, y, z = points[bad]
        raise ValueError(f"vertex {bad} is ({x:g}, {y:g}, {z:g}): coordinates must be finite; clean the mesh")


def _format_error(error: Exception) -> str:
    """Return the text of an exception in one line."""
    return " ".join(str(error).split())[:_REASON_MAX] or type(error).__name__
