"""Files in the binary form of glTF."""

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np


class Glb:
    """Builder of a GLB file: add accessors, then get its bytes from `data`."""

    def __init__(self) -> None:
        self.blob = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, array: np.ndarray, stride: int = 0) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        rows = array.reshape(len(array), -1)
        data = b"".join(row.tobytes().ljust(stride, b"\0") for row in rows)
        self.views.append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)})
        if stride:
            self.views[-1]["byteStride"] = stride
        self.blob += data
        return len(self.views) - 1

    def add(self, array: np.ndarray, stride: int = 0, **more: Any) -> int:
        codes = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
        entry = {"bufferView": self.view(array, stride), "componentType": codes[array.dtype.name], "count": len(array)}
        self.accessors.append(entry | {"type": "VEC3" if array.ndim == 2 else "SCALAR"} | more)
        return len(self.accessors) - 1

    def data(
        self,
        primitives: list[dict[str, Any]],
        node: dict[str, Any] | None = None,
        changes: Callable[[dict[str, Any]], None] = lambda head: None,
        **more: Any,
    ) -> bytes:
        """Return the bytes of the file after `changes` of its header."""
        head = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0} | (node or {})],
            "meshes": [{"primitives": primitives}], "accessors": self.accessors, "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.blob)}],
        } | more  # fmt: skip
        changes(head)
        text = json.dumps(head).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x4E4942) + blob
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
