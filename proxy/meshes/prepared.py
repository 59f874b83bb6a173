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
from softfinger.proxy.meshes.reading import Arrays, arrays_of, read_bytes
from softfinger.proxy.meshes.report import MeshReport, report_of
from softfinger.proxy.meshes.thinning import thin_mesh

if TYPE_CHECKING:
    from softfinger.proxy.elastic.solution import ElasticBody
    from softfinger.proxy.meshes.tree import Tree

TREES: Final = 16
"""Number of meshes whose trees stay in memory; the disk cache has the others."""
ABOUTS: Final = 2 * int(limits.OBJECTS.high)
"""Number of reports and pictures in memory, each at most a megabyte.

Each is stored twice: under the state of its file, and under its path and scale.
"""


class About(NamedTuple):
    """Report on a mesh, and the triangles of its picture, m."""

    report: MeshReport
    picture: Arrays


class _Memory:
    """Least-recently-used cache of at most `most` values, for several threads."""

    def __init__(self, most: int) -> None:
        self._made: OrderedDict[Any, Any] = OrderedDict()
        self._most = most
        self._lock = threading.Lock()

    def get(self, key: Any) -> Any:
        with self._lock:
            if key in self._made:
                self._made.move_to_end(key)
            return self._made.get(key)

    def put(self, key: Any, value: Any) -> None:
        with self._lock:
            self._made[key] = value
            while len(self._made) > self._most:
                self._made.popitem(last=False)


_abouts: Final = _Memory(ABOUTS)
_trees: Final = _Memory(TREES)


def about(obj: schema.Mesh) -> About:
    """Return report and picture of an object's mesh.

    Raises ConfigError, with the object's name, if the file is unusable.
    """
    state = _state(obj)
    summary: About | None = _abouts.get(state)
    if summary is None:
        summary = _about(_read_and_mend(obj, _bytes(obj)))
        _remember(obj, state, summary)
    return summary


def latest_picture(obj: schema.Mesh) -> About:
    """Return report and picture as of the last build of an object's mesh, even if its file has changed since.

    Without a previous build, return the result of `about`.
    """
    summary: About | None = _abouts.get(_source(obj))
    return about(obj) if summary is None else summary


STAGES: Final = 4
"""Stages of a mesh that is not cached: read, repair, build the tree, compute its figures."""


def tree_of(obj: schema.Mesh, folder: Folder = array_cache.FOLDER) -> Tree:
    """Return the tree of an object's mesh, and store it on disk for later runs. Raises ConfigError as `about` does."""
    from softfinger.proxy.meshes import tree as trees  # its kernels are only for scenes with a mesh

    state = _state(obj)
    tree: Tree | None = _trees.get(state)
    if tree is not None:
        return tree
    data = _bytes(obj)
    key = _key(data, obj)
    tree, summary = _from_disk(key, trees.Tree, folder) or (None, None)
    if tree is None or summary is None:
        if obj.elastic is not None:
            _body(obj)  # shows its own progress
        with progress.display(f"building the mesh of {obj.name}", STAGES) as advance:
            mended = _read_and_mend(obj, data, advance)
            tree = trees.build_tree(*mended[0])
            advance(3)
            summary = _about(mended)
            advance(STAGES)
        array_cache.save(key, _to_disk(tree, summary), folder)
    _remember(obj, state, summary)
    _trees.put(state, tree)
    return tree


def _remember(obj: schema.Mesh, state: Any, summary: About) -> None:
    _abouts.put(state, summary)
    _abouts.put(_source(obj), summary)


def _source(obj: schema.Mesh) -> tuple[Any, ...]:
    """Return the keys of an object that name its triangles."""
    return obj.file, obj.mesh, obj.root, obj.scale, obj.elastic


def _bytes(obj: schema.Mesh) -> bytes:
    """Return the content of a file, or the numbers of a model's mesh."""
    try:
        if obj.mesh is None:
            return read_bytes(obj.file)
        return b"".join(array.tobytes() for array in read_mesh(obj.file, obj.root, obj.mesh))
    except ConfigError as error:
        raise ConfigError(f"object '{obj.name}': file: {error}") from error


def _body(obj: schema.Mesh) -> ElasticBody:
    from softfinger.proxy.elastic.prepared import body_of  # SciPy, only for elastic objects

    return body_of(obj)


def _read_and_mend(
    obj: schema.Mesh, data: bytes, advance: Callable[[int], None] = lambda stage: None
) -> tuple[Arrays, MeshReport]:
    if obj.elastic is not None:
        mended = mend(_body(obj).surface, loose=False)
        return mended.arrays, report_of(mended, loose=False, scale=None)
    try:
        if obj.mesh is None:
            vertices, triangles = arrays_of(obj.file, data)
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
    return mended.arrays, report_of(mended, loose, obj.scale if obj.mesh is None else None)


def _about(mended: tuple[Arrays, MeshReport]) -> About:
    return About(mended[1], thin_mesh(mended[0]))


def _state(obj: schema.Mesh) -> Any:
    """Return a key that changes if the triangles of an object may have changed."""
    if obj.mesh is not None:
        return hashlib.sha256(_bytes(obj)).digest(), *_source(obj)
    try:
        status = os.stat(obj.file)
    except (OSError, ValueError):
        return None, *_source(obj)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, *_source(obj)


def _key(data: bytes, obj: schema.Mesh) -> str:
    """Return a hash of the file's bytes, its ending and scale, and the program's source."""
    digest = hashlib.sha256(data)
    parts: tuple[Any, ...] = SOURCE_HASH, len(data), Path(obj.file).suffix.lower(), obj.scale
    if obj.elastic is not None:
        parts = (*parts, *(hashlib.sha256(array.tobytes()).digest() for array in _body(obj).surface))
    digest.update(repr(parts).encode())
    return digest.hexdigest()


def _to_disk(tree: Tree, summary: About) -> array_cache.CachedArrays:
    fields = tree._asdict()
    arrays = {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}
    numbers = {name: np.asarray(value).item() for name, value in fields.items() if name not in arrays}
    pictures = {f"picture.{name}": value for name, value in summary.picture._asdict().items()}
    return array_cache.CachedArrays(arrays | pictures, {"numbers": numbers, "report": asdict(summary.report)})


def _from_disk(key: str, kind: type[Tree], folder: Folder) -> tuple[Tree, About] | None:
    cached = array_cache.load(key, folder)
    if cached is None:
        return None
    arrays: dict[str, Any] = dict(cached.arrays)
    values = cached.values
    picture = Arrays(arrays.pop("picture.vertices"), arrays.pop("picture.triangles"))
    report = msgspec.convert(values["report"], MeshReport)
    return kind(**arrays, **values["numbers"]), About(report, picture)
