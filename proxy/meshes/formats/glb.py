"""GLB, the binary file of glTF 2.0: triangles of all meshes, each where the nodes of the scene place it.

An extension that changes positions is refused by its name.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits
from softfinger.proxy.meshes.formats.polygons import Faces, Indices, Points, require_triangles, split_strip
from softfinger.proxy.rotation import make_matrix

_COMPONENTS: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC3": 3}
_HARMLESS: Final = (
    *("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_punctual", "KHR_xmp"),
    *("MSFT_texture_", "EXT_lights_", "KHR_animation_pointer"),
)
"""Extensions, by the beginning of their names, that leave positions and triangles as they are."""
TRIANGLES: Final = 4
STRIP: Final = 5
TRIANGLE_FAN: Final = 6
"""Modes of a part of a mesh; smaller ones are points and lines."""
_JSON: Final = 0x4E4F534A
COUNT_MAX: Final = 3 * int(limits.MESH_TRIANGLES.high)
"""Entries of an accessor."""


def read(data: bytes) -> Faces:
    """Return the triangles of a GLB file, in the unit of its scene."""
    head, buffer = _read_chunks(data)
    for name in head.get("extensionsRequired", []):
        if not str(name).startswith(_HARMLESS):
            obstacle = "is compressed" if "compression" in str(name) else "needs an unsupported extension"
            raise ValueError(f"{obstacle} ({str(name)[:60]}): export it without")
    file = _File(head, buffer)
    parts, promised = list[tuple[Points, Indices]](), 0
    for mesh, place in _iterate_meshes(head):
        for primitive in head["meshes"][mesh]["primitives"]:
            if primitive.get("mode", TRIANGLES) < TRIANGLES:  # points and lines have no surface
                continue
            promised += file.count_triangles(primitive)
            if promised > limits.MESH_TRIANGLES.high:
                raise ValueError(f"has more than {limits.MESH_TRIANGLES.high:,} triangles, the limit: decimate it")
            points, triangles = file.triangles(primitive)
            if (place != np.eye(4)).any():  # a copy costs as much as the reading
                points = points @ place[:3, :3].T + place[:3, 3]
                triangles = triangles[:, ::-1] if np.linalg.det(place[:3, :3]) < 0.0 else triangles
            parts.append((points, triangles))
    if len(parts) < 2:
        points, triangles = parts[0] if parts else (np.empty((0, 3)), np.empty((0, 3), np.int64))
        return require_triangles(points, triangles, promised)
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    triangles = np.concatenate([part + start for (_, part), start in zip(parts, starts[:-1], strict=True)])
    return require_triangles(np.concatenate([points for points, _ in parts]), triangles, promised)


def _read_chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk."""
    magic, version, size = struct.unpack_from("<4sII", data.ljust(12, b"\0"))
    if magic != b"glTF" or version != 2:
        raise ValueError(f"is not a GLB file of glTF 2.0: it starts with {data[:8]!r}")
    if size > len(data):
        raise ValueError(f"is damaged or not a GLB file: {size:,} bytes, but has {len(data):,}: it is truncated")
    length, kind = struct.unpack_from("<II", data, 12)
    if kind != _JSON:
        raise ValueError("is damaged or not a GLB file: its first chunk is not JSON")
    start = 20 + length
    binary = struct.unpack_from("<I", data, start)[0] if size >= start + 8 else 0
    try:
        head = json.loads(data[20:start])
    except ValueError as error:
        raise ValueError(f"is damaged or not a GLB file: its JSON: {error}") from error
    if not isinstance(head, dict):
        raise ValueError("is damaged or not a GLB file: its JSON is not an object")
    return head, data[start + 8 : start + 8 + binary]


def _iterate_meshes(head: dict[str, Any]) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield each mesh of the scene and its matrix (4, 4)."""
    nodes = head.get("nodes", [])
    children = {int(child) for node in nodes for child in node.get("children", [])}
    scenes = head.get("scenes") or [{"nodes": [number for number in range(len(nodes)) if number not in children]}]
    waiting = [(int(node), np.eye(4)) for node in scenes[head.get("scene", 0)].get("nodes", [])]
    visited = set[int]()
    while waiting:
        number, above = waiting.pop()
        node = nodes[number]
        if number in visited:
            raise ValueError(f"is damaged: the node {number} has two parents, or is its own ancestor")
        visited.add(number)
        place = above @ _read_matrix(node)
        waiting += [(int(child), place) for child in node.get("children", [])]
        if "mesh" not in node:
            continue
        if "skin" in node:
            raise ValueError(f"is deformed by a skeleton (the skin of node {number}): apply it before the export")
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise ValueError("has copies by EXT_mesh_gpu_instancing: export them as nodes")
        if any(node.get("weights") or head["meshes"][node["mesh"]].get("weights") or []):
            raise ValueError(f"has morph targets with weights (node {number}): apply it before the export")
        yield int(node["mesh"]), place


def _read_matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix (4, 4) from a node to the one above it."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = (float(part) for part in node.get("rotation", (0.0, 0.0, 0.0, 1.0)))
    turn = np.array(make_matrix((w, x, y, z)))
    place = np.eye(4)
    place[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)), float)
    place[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return place


class _File:
    """Accessors of a file: `head` is its JSON, `buffer` its binary chunk."""

    def __init__(self, head: dict[str, Any], buffer: bytes) -> None:
        self._head, self._buffer = head, buffer

    def count_triangles(self, primitive: dict[str, Any]) -> int:
        """Return the number of triangles of a part of a mesh, from only its mode and the count of its accessor."""
        accessor = self._head["accessors"][primitive.get("indices", primitive["attributes"]["POSITION"])]
        corners, mode = int(accessor["count"]), primitive.get("mode", TRIANGLES)
        if mode not in (TRIANGLES, STRIP, TRIANGLE_FAN) or (mode == TRIANGLES and corners % 3):
            raise ValueError(f"is damaged: {corners:,} corners in the mode {mode!r}")
        return corners // 3 if mode == TRIANGLES else max(corners - 2, 0)

    def triangles(self, primitive: dict[str, Any]) -> tuple[Points, Indices]:
        """Return vertices and triangles of a part of a mesh."""
        points = self._read_accessor(primitive["attributes"]["POSITION"], "VEC3").astype(np.float64)
        numbers = primitive.get("indices")
        corners = np.arange(len(points)) if numbers is None else self._read_accessor(numbers, "SCALAR")[:, 0]
        if len(corners) and not (corners.min() >= 0 and corners.max() < len(points)):
            raise ValueError(f"is damaged: a triangle has a corner beyond the vertices 0 to {len(points) - 1}")
        corners = corners.astype(np.int64)
        mode = primitive.get("mode", TRIANGLES)
        if mode == TRIANGLES:
            return points, corners.reshape(-1, 3)
        if mode == STRIP or len(corners) < 3:
            return points, split_strip(corners)
        return points, np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)

    def _read_accessor(self, number: int, kind: str) -> NDArray[Any]:
        """Return the entries (count, width) of an accessor; integers that are normalized as fractions."""
        accessor = self._head["accessors"][number]
        count, component = int(accessor["count"]), np.dtype(_COMPONENTS[accessor["componentType"]])
        if accessor["type"] != kind or not 0 <= count <= COUNT_MAX:
            raise ValueError(f"is damaged or not a GLB file: {count:,} {accessor['type']}, must be {kind}")
        if "bufferView" not in accessor and "sparse" not in accessor:
            raise ValueError(
                f"has no data for accessor {number}: it is compressed or truncated; export it without compression"
            )
        width = _WIDTHS[kind]
        values = np.zeros((count, width), component)
        if "bufferView" in accessor:
            values = self._view(accessor["bufferView"], accessor.get("byteOffset", 0), count, width, component)
        if sparse := accessor.get("sparse"):
            values, entries = values.copy(), int(sparse["count"])
            rows, new = sparse["indices"], sparse["values"]
            kind_of_rows = np.dtype(_COMPONENTS[rows["componentType"]])
            places = self._view(rows["bufferView"], rows.get("byteOffset", 0), entries, 1, kind_of_rows)[:, 0]
            values[places] = self._view(new["bufferView"], new.get("byteOffset", 0), entries, width, component)
        if accessor.get("normalized") and component.kind in "iu":
            return np.asarray(np.maximum(values / np.iinfo(component).max, -1.0))
        return values

    def _view(self, number: int, offset: int, count: int, width: int, component: np.dtype[Any]) -> NDArray[Any]:
        """Return rows (count, width) of a buffer view."""
        view = self._head["bufferViews"][number]
        if packed := [name for name in view.get("extensions", {}) if "compression" in name]:
            raise ValueError(f"is compressed ({packed[0]}): export it without compression")
        data = self._read_data(view.get("buffer", 0))
        row = width * component.itemsize
        stride, start = view.get("byteStride") or row, view.get("byteOffset", 0) + offset
        end = start + max(count - 1, 0) * stride + row * min(count, 1)
        if (
            min(start, offset, count) < 0
            or stride < row
            or end > min(len(data), view.get("byteOffset", 0) + view["byteLength"])
        ):
            raise ValueError(f"is damaged or not a GLB file: buffer view {number} ends before its {count:,} entries")
        return np.ndarray((count, width), component, data, start, (stride, component.itemsize))

    def _read_data(self, number: int) -> bytes:
        address = self._head["buffers"][number].get("uri")
        if address is None and number == 0:
            return self._buffer
        if not str(address).startswith("data:"):
            raise ValueError(f"stores its numbers in another file, {str(address)[:80]!r}: export it as one file")
        return base64.b64decode(str(address).partition(",")[2])
