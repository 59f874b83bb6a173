"""Reading of mesh files by trimesh, with all parts of a file in one mesh and without opening any other file.

trimesh is an extra and imported late.
"""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.proxy.meshes.promises import CHECKS

Vertices = NDArray[np.float64]
Triangles = NDArray[np.int32]

BYTES_MAX: Final = int(limits.MESH_BYTES.high)
SAYS_MORE: Final = {"ply": "faces of a binary one all have as many corners as the first: triangulate it"}
"""Further possible cause when trimesh cannot read a file."""
_REASON_MAX: Final = 200
"""Limit of the text of a library in a message, characters."""


class Arrays(NamedTuple):
    """vertices (n, 3) float64, in the file's unit or m; triangles (m, 3) int32, vertex indices."""

    vertices: Vertices
    triangles: Triangles


def read_bytes(path: str | Path) -> bytes:
    """Return the contents of a mesh file.

    Raises ConfigError if it is missing or too large, or if its ending is unknown.
    """
    if _kind(path) not in CHECKS:
        raise ConfigError(f"{path}: is none of {', '.join(f'.{kind}' for kind in CHECKS)}: export it as one of these")
    try:
        return read_input(path, BYTES_MAX)
    except (OSError, MemoryError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ConfigError(f"{path}: cannot be read: {reason}") from error


def arrays_of(path: str | Path, data: bytes) -> Arrays:
    """Return vertices and triangles from the bytes of a mesh file; its ending selects the format.

    Raises ConfigError with the file and the fault.
    """
    kind = _kind(path)
    try:
        promised = CHECKS[kind](data)
        scene = _scene(path, data)
        vertices, triangles = _joined(scene)
        _check(vertices, triangles, promised)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{path}: {_line(error)}") from error
    except Exception as error:  # of parts that trimesh loads lazily
        raise ConfigError(f"{path}: is damaged, or no {kind.upper()} file: {_line(error)}") from error
    return Arrays(np.ascontiguousarray(vertices), np.ascontiguousarray(triangles, dtype=np.int32))


def _kind(path: str | Path) -> str:
    return Path(path).suffix.lower().removeprefix(".")


def _scene(path: str | Path, data: bytes) -> Any:
    """Return trimesh's scene of a file. Raises ConfigError if trimesh cannot read it."""
    try:
        import trimesh
    except ImportError as error:
        raise ConfigError(f"a mesh needs trimesh: pip install 'softfinger[mesh]' ({error})") from error
    from trimesh.resolvers import Resolver

    class Refusing(Resolver):  # type: ignore[misc]
        """Resolver that opens no other file: a reference to one could lead anywhere, including the network."""

        def __init__(self) -> None: ...

        def get(self, key: str) -> bytes:
            raise ValueError(f"has its numbers in another file, {key[:80]!r}: export it as one file")

        def write(self, name: str, data: Any) -> None: ...

        def namespaced(self, namespace: str) -> Resolver:
            return self

        def keys(self) -> list[str]:
            return []

    kind = _kind(path)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # the checks here replace its warnings
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        try:
            return trimesh.load_scene(
                io.BytesIO(data), file_type=kind, resolver=Refusing(), process=False, skip_materials=True
            )
        except Exception as error:  # its readers raise many types of errors on damaged bytes
            known = ("; " + SAYS_MORE[kind]) if kind in SAYS_MORE else ""
            raise ConfigError(f"{path}: is damaged, or no {kind.upper()} file: {_line(error)}{known}") from error


def _joined(scene: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices and triangles of all parts, each placed as in the file."""
    points, corners, start = [], [], 0
    for node in scene.graph.nodes_geometry:
        place, name = scene.graph[node]
        part = scene.geometry[name]
        if not hasattr(part, "faces"):  # points or lines
            continue
        vertices = np.asarray(part.vertices, dtype=np.float64)
        triangles = np.asarray(part.faces, dtype=np.int64)
        _check_shapes(vertices, triangles)
        if not np.array_equal(place, np.eye(4)):
            vertices = vertices @ place[:3, :3].T + place[:3, 3]
            triangles = triangles[:, ::-1] if np.linalg.det(place[:3, :3]) < 0.0 else triangles
        points.append(vertices)
        corners.append(triangles + start if start else triangles)
        start += len(vertices)
    if not points:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    if len(points) == 1:
        return points[0], corners[0]
    return np.concatenate(points), np.concatenate(corners)


def _check(vertices: NDArray[np.float64], triangles: NDArray[np.int64], promised: int) -> None:
    if len(triangles) == 0:
        raise ValueError("has no triangles: it is damaged, or has points alone, which have no surface; mesh them first")
    if len(triangles) > limits.MESH_TRIANGLES.high:
        raise ValueError(f"has {len(triangles):,} triangles, {limits.MESH_TRIANGLES.high:,} are the most: decimate it")
    if promised > len(triangles):
        raise ValueError(f"promises {promised:,} faces, and has {len(triangles):,}: it was cut off, or is damaged")
    if not np.isfinite(vertices).all():
        bad = np.argmin(np.isfinite(vertices).all(axis=1))
        x, y, z = vertices[bad]
        raise ValueError(f"vertex {bad} is ({x:g}, {y:g}, {z:g}): coordinates must be finite; clean the mesh")


def _check_shapes(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> None:
    vertices = len(points)
    if points.ndim != 2 or points.shape[1:] != (3,):
        raise ValueError(f"is damaged: its vertices are of the shape {points.shape}, must have three coordinates")
    if triangles.ndim != 2 or triangles.shape[1:] != (3,):
        raise ValueError(f"has faces of {triangles.shape[1:]} corners, must have triangles: triangulate it")
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < vertices):
        bad = np.argmax(((triangles < 0) | (triangles >= vertices)).any(axis=1))
        corners = ", ".join(map(str, triangles[bad]))
        raise ValueError(f"triangle {bad} has the corners {corners}, and there are vertices 0 to {vertices - 1}")


def _line(error: Exception) -> str:
    """Return the text of an exception on one line."""
    return " ".join(str(error).split())[:_REASON_MAX] or type(error).__name__
