"""Solved elastic body, and its file next to a scene, which then runs without mesher and solver, with the same bits.

The file is an uncompressed .npz of numbers, without pickles. The compliance is stored as float32 of its lower triangle:
18 n^2 bytes for n nodes. A hash covers the numbers, the mesh file, and all values that change the solution.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits, schema
from softfinger.config.arrays.grids import open_npz
from softfinger.config.files import read_input, write_new_file
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.meshes.reading import Arrays

VERSION: Final = 1
BYTES_MAX: Final = int(40 * limits.ELASTIC_NODES.high**2)
TYPES: Final = {
    "hash": "uint8",
    "vertices": "float64",
    "triangles": "int32",
    "nodes": "int32",
    "compliance": "float32",
    "bending": "float32",
    "report": "uint8",
}
"""Arrays of a file, in the order in which they are hashed."""


class Report(NamedTuple):
    """Figures of a body, of Young's modulus 1 Pa.

    points       (k, 3) m  of the surface, spread over it
    compliances  (k,)      displacement there along the normal under 1 N, m/N times 1 Pa
    error        1         their largest error, estimated with a coarser mesh, over their largest value; None without
                           such a mesh
    """

    vertices: int
    tetrahedra: int
    nodes: int
    worst_quality: float
    mean_quality: float
    points: list[list[float]]
    compliances: list[float]
    error: float | None


class ElasticBody(NamedTuple):
    """Surface (vertices, m, and triangles), its compliant vertices, their compliance, and figures.

    nodes       (n,)       indices of the compliant vertices
    compliance  (n n 9,)   see `compliance.Solution`
    bending     (n 3 2,)   see `compliance.Solution`
    """

    surface: Arrays
    nodes: NDArray[np.int32]
    compliance: ReadOnly
    bending: ReadOnly
    report: Report


def make_identity(obj: schema.Mesh, elastic: schema.Elastic, data: bytes) -> str:
    """Return all that determines the solution of a mesh object with the file `data`: that of Young's modulus 1 Pa.

    Under gravity the modulus itself belongs to it.
    """
    sag = None if elastic.density_kg_per_m3 is None else (elastic.density_kg_per_m3, elastic.youngs_pa)
    regions = [msgspec.to_builtins(region) for region in (elastic.fixed, elastic.reach)]
    size = elastic.resolution_m, elastic.radius_m, obj.scale
    file = hashlib.sha256(data).hexdigest(), Path(obj.file).suffix.lower()
    return repr((VERSION, file, size, elastic.poisson, regions, sag))


def save(path: str, key: str, body: ElasticBody) -> None:
    """Write a body, of the identity `key`."""
    count = 3 * len(body.nodes)
    square = body.compliance.array.reshape(len(body.nodes), len(body.nodes), 3, 3)
    rows = square.transpose(0, 2, 1, 3).reshape(count, count)
    arrays: dict[str, NDArray[Any]] = {
        "vertices": body.surface.vertices,
        "triangles": body.surface.triangles,
        "nodes": body.nodes,
        "compliance": rows[np.tril_indices(count)].astype(np.float32),
        "bending": body.bending.array.astype(np.float32),
        "report": np.frombuffer(msgspec.json.encode(body.report._asdict()), np.uint8),
    }
    arrays["hash"] = _hash(key, arrays)
    with write_new_file(path) as file:
        np.savez(file, **{name: arrays[name] for name in TYPES})  # type: ignore[arg-type]


def read(path: str, key: str) -> ElasticBody:
    """Return the body in a file.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is damaged, or of another identity than `key`.
    """
    arrays = _read_arrays(read_input(path, BYTES_MAX))
    if arrays["hash"].tobytes() != _hash(key, arrays).tobytes():
        raise ValueError("is damaged or the solution for other values")
    nodes, vertices = arrays["nodes"], arrays["vertices"].reshape(-1, 3)
    count = 3 * len(nodes)
    square = np.zeros((count, count))
    square[np.tril_indices(count)] = arrays["compliance"]
    square += np.tril(square, -1).T
    blocks = square.reshape(len(nodes), 3, len(nodes), 3).transpose(0, 2, 1, 3)
    report = Report(**msgspec.json.decode(arrays["report"].tobytes()))
    surface = Arrays(vertices, arrays["triangles"].reshape(-1, 3))
    return ElasticBody(surface, nodes, ReadOnly(blocks), ReadOnly(arrays["bending"].astype(np.float64)), report)


def _read_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file. Raises ValueError unless it has exactly those of TYPES, uncompressed."""
    file = io.BytesIO(data)
    try:
        with open_npz(file) as archive:
            members = zipfile.ZipFile(file).infolist()
            stored = all(member.compress_type == zipfile.ZIP_STORED for member in members)
            if not stored or [member.filename for member in members] != [f"{name}.npy" for name in TYPES]:
                raise ValueError("is not a solution of an elastic body")
            arrays = {name: np.asarray(archive[name]) for name in TYPES}
    except (zipfile.BadZipFile, EOFError, KeyError, OverflowError, SyntaxError, MemoryError) as error:
        raise ValueError(f"is damaged: {error}") from error
    if any(array.dtype.name != TYPES[name] for name, array in arrays.items()):
        raise ValueError("is not a solution of an elastic body")
    return arrays


def _hash(key: str, arrays: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
    digest = hashlib.sha256(key.encode())
    for name in TYPES:
        if name != "hash":
            digest.update(repr(arrays[name].shape).encode() + np.ascontiguousarray(arrays[name]).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
