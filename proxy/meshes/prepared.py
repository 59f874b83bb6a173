"""Meshes of a scene, from the file to the tree that is rendered.

Results are cached in memory and on disk while the file, its scale and the program stay the same. Called when a scene is
built, described or drawn.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.config.mjcf import read_mesh
from softfinger.proxy import progress
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.kernels.jit.source_hash import SOURCE_HASH
from softfinger.proxy.meshes import array_cache
from softfinger.proxy.meshes.mending import mend
from softfinger.proxy.meshes.reading import Arrays, parse_mesh, read_bytes
from softfinger.proxy.meshes.report import MeshReport, make_report
from softfinger.proxy.meshes.thinning import thin_mesh

if TYPE_CHECKING:
    from softfinger.proxy.elastic.solution import ElasticBody
    from softfinger.proxy.meshes.tree import Tree

TREES_IN_MEMORY: Final = 16
"""Number of meshes whose trees stay in memory; the disk cache has the others."""
REPORTS_IN_MEMORY: Final = 2 * int(limits.OBJECTS.high)
"""Number of reports and pictures in memory, each at most a megabyte.

Each is stored twice: under the state of its file, and under its path and scale.
"""


class MeshDescription(NamedTuple):
    """Report on a mesh, and the triangles of its picture, m."""

    report: MeshReport
    picture: Arrays


class _Memory:
    """Least-recently-used cache of at most `most` values, for several threads."""

    def __init__(self, most: int) -> None:
        self._entries: OrderedDict[Any, Any] = OrderedDict()
        self._most = most
        self._lock = threading.Lock()

    def get(self, key: Any) -> Any:
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
            return self._entries.get(key)

    def put(self, key: Any, value: Any) -> None:
        with self._lock:
            self._entries[key] = value
            while len(self._entries) > self._most:
                self._entries.popitem(last=False)


_abouts: Final = _Memory(REPORTS_IN_MEMORY)
_trees: Final = _Memory(TREES_IN_MEMORY)


def describe_mesh(obj: schema.Mesh) -> MeshDescription:
    """Return report and picture of an object's mesh.

    Raises ConfigError, with the object's name, if the file is unusable.
    """
    state = _stat_source(obj)
    summary: MeshDescription | None = _abouts.get(state)
    if summary is None:
        summary = _describe(_read_and_mend(obj, _read_bytes(obj)))
        _remember(obj, state, summary)
    return summary


def load_latest_picture(obj: schema.Mesh) -> MeshDescription:
    """Return report and picture as of the last build of an object's mesh, even if its file has changed since.

    Without a previous build, return the result of `describe_mesh`.
    """
    summary: MeshDescription | None = _abouts.get(_find_source(obj))
    return describe_mesh(obj) if summary is None else summary


STAGES: Final = 4
"""Stages of a mesh that is not cached: read, repair, build the tree, compute its figures."""


def prepare_tree(obj: schema.Mesh, folder: Folder = array_cache.FOLDER) -> Tree:
    """Return the tree of an object's mesh, and store it on disk for later runs. Raises as `describe_mesh`."""
    from softfinger.proxy.meshes import tree as trees  # its kernels are only for scenes with a mesh

    state = _stat_source(obj)
    tree: Tree | None = _trees.get(state)
    if tree is not None:
        return tree
    data = _read_bytes(obj)
    key = _make_key(data, obj)
    tree, summary = _from_disk(key, trees.Tree, folder) or (None, None)
    if tree is None or summary is None:
        if obj.elastic is not None:
            _prepare_body(obj)  # also displays its progress
        with progress.display(f"building the mesh of {obj.name}", STAGES) as advance:
            mended = _read_and_mend(obj, data, advance)
            tree = trees.build_tree(*mended[0])
            advance(3)
            summary = _describe(mended)
            advance(STAGES)
        array_cache.save(key, _to_disk(tree, summary), folder)
    _remember(obj, state, summary)
    _trees.put(state, tree)
    return tree


def _remember(obj: schema.Mesh, state: Any, summary: MeshDescription) -> None:
    _abouts.put(state, summary)
    _abouts.put(_find_source(obj), summary)


def _find_source(obj: schema.Mesh) -> tuple[Any, ...]:
    """Return the keys of an object that name its triangles."""
    return obj.file, obj.mesh, obj.root, obj.scale, obj.elastic


def _read_bytes(obj: schema.Mesh) -> bytes:
    """Return the content of a file, or the numbers of a model's mesh."""
    try:
        if obj.mesh is None:
            return read_bytes(obj.file)
        return b"".join(array.tobytes() for array in read_mesh(obj.file, obj.root, obj.mesh))
    except ConfigError as error:
        raise ConfigError(f"object '{obj.name}': file: {error}") from error


def _prepare_body(obj: schema.Mesh) -> ElasticBody:
    from softfinger.proxy.elastic.prepared import prepare_body  # SciPy, only for elastic objects

    return prepare_body(obj)


def _read_and_mend(
    obj: schema.Mesh, data: bytes, advance: Callable[[int], None] = lambda stage: None
) -> tuple[Arrays, MeshReport]:
    if obj.elastic is not None:
        mended = mend(_prepare_body(obj).surface, loose=False)
        return mended.arrays, make_report(mended, loose=False, scale=None)
    try:
        if obj.mesh is None:
            vertices, triangles = parse_mesh(obj.file, data)
        else:
            vertices, triangles = read_mesh(obj.file, obj.root, obj.mesh)
        loose = obj.file.lower().endswith(".stl")
        with np.errstate(over="ignore"):  # infinite coordinates are rejected later
            vertices = vertices * obj.scale
        advance(1)
        mended = mend(Arrays(vertices, triangles), loose)
        advance(2)
    except ConfigError as error:
        raise ConfigError(f"object '{obj.name}': file: {error}") from error
    except ValueError as error:
        raise ConfigError(f"object '{obj.name}': file: {obj.file}: {error}") from error
    return mended.arrays, make_report(mended, loose, obj.scale if obj.mesh is None else None)


def _describe(mended: tuple[Arrays, MeshReport]) -> MeshDescription:
    return MeshDescription(mended[1], thin_mesh(mended[0]))


def _stat_source(obj: schema.Mesh) -> Any:
    """Return a key that changes if the triangles of an object may have changed."""
    if obj.mesh is not None:
        return hashlib.sha256(_read_bytes(obj)).digest(), *_find_source(obj)
    try:
        status = os.stat(obj.file)
    except (OSError, ValueError):
        return None, *_find_source(obj)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, *_find_source(obj)


def _make_key(data: bytes, obj: schema.Mesh) -> str:
    """Return a hash of the file's bytes, its ending and scale, and the program's source."""
    digest = hashlib.sha256(data)
    parts: tuple[Any, ...] = SOURCE_HASH, len(data), Path(obj.file).suffix.lower(), obj.scale
    if obj.elastic is not None:
        parts = (*parts, *(hashlib.sha256(array.tobytes()).digest() for array in _prepare_body(obj).surface))
    digest.update(repr(parts).encode())
    return digest.hexdigest()


def _to_disk(tree: Tree, summary: MeshDescription) -> array_cache.CachedArrays:
    fields = tree._asdict()
    arrays = {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}
    numbers = {name: np.asarray(value).item() for name, value in fields.items() if name not in arrays}
    pictures = {f"picture.{name}": value for name, value in summary.picture._asdict().items()}
    return array_cache.CachedArrays(arrays | pictures, {"numbers": numbers, "report": asdict(summary.report)})


def _from_disk(key: str, kind: type[Tree], folder: Folder) -> tuple[Tree, MeshDescription] | None:
    cached = array_cache.load(key, folder)
    if cached is None:
        return None
    arrays: dict[str, Any] = dict(cached.arrays)
    values = cached.values
    picture = Arrays(arrays.pop("picture.vertices"), arrays.pop("picture.triangles"))
    report = msgspec.convert(values["report"], MeshReport)
    return kind(**arrays, **values["numbers"]), MeshDescription(report, picture)
