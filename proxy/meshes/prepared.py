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


def about(thing: schema.Mesh) -> About:
    """Return report and picture of an object's mesh.

    Raises ConfigError, with the object's name, if the file is unusable.
    """
    state = _state(thing)
    summary: About | None = _abouts.get(state)
    if summary is None:
        summary = _about(_read_and_mend(thing, _bytes(thing)))
        _remember(thing, state, summary)
    return summary


def latest_picture(thing: schema.Mesh) -> About:
    """Return report and picture as of the last build of an object's mesh, even if its file has changed since.

    Without a previous build, return the result of `about`.
    """
    summary: About | None = _abouts.get(_source(thing))
    return about(thing) if summary is None else summary


STAGES: Final = 4
"""Stages of a mesh that is not cached: read, repair, build the tree, compute its figures."""


def tree_of(thing: schema.Mesh, folder: Folder = array_cache.FOLDER) -> Tree:
    """Return the tree of an object's mesh, and store it on disk for later runs. Raises ConfigError as `about` does."""
    from softfinger.proxy.meshes import tree as trees  # its kernels are only for scenes with a mesh

    state = _state(thing)
    tree: Tree | None = _trees.get(state)
    if tree is not None:
        return tree
    data = _bytes(thing)
    key = _key(data, thing)
    tree, summary = _from_disk(key, trees.Tree, folder) or (None, None)
    if tree is None or summary is None:
        if thing.elastic is not None:
            _body(thing)  # shows its own progress
        with progress.display(f"building the mesh of {thing.name}", STAGES) as advance:
            mended = _read_and_mend(thing, data, advance)
            tree = trees.build_tree(*mended[0])
            advance(3)
            summary = _about(mended)
            advance(STAGES)
        array_cache.save(key, _to_disk(tree, summary), folder)
    _remember(thing, state, summary)
    _trees.put(state, tree)
    return tree


def _remember(thing: schema.Mesh, state: Any, summary: About) -> None:
    _abouts.put(state, summary)
    _abouts.put(_source(thing), summary)


def _source(thing: schema.Mesh) -> tuple[Any, ...]:
    """Return the keys of an object that name its triangles."""
    return thing.file, thing.mesh, thing.root, thing.scale, thing.elastic


def _bytes(thing: schema.Mesh) -> bytes:
    """Return the content of a file, or the numbers of a model's mesh."""
    try:
        if thing.mesh is None:
            return read_bytes(thing.file)
        return b"".join(array.tobytes() for array in read_mesh(thing.file, thing.root, thing.mesh))
    except ConfigError as error:
        raise ConfigError(f"object '{thing.name}': file: {error}") from error


def _body(thing: schema.Mesh) -> ElasticBody:
    from softfinger.proxy.elastic.prepared import body_of  # SciPy, only for elastic objects

    return body_of(thing)


def _read_and_mend(
    thing: schema.Mesh, data: bytes, advance: Callable[[int], None] = lambda stage: None
) -> tuple[Arrays, MeshReport]:
    if thing.elastic is not None:
        mended = mend(_body(thing).surface, loose=False)
        return mended.arrays, report_of(mended, loose=False, scale=None)
    try:
        if thing.mesh is None:
            vertices, triangles = arrays_of(thing.file, data)
        else:
            vertices, triangles = read_mesh(thing.file, thing.root, thing.mesh)
        loose = thing.file.lower().endswith(".stl")
        with np.errstate(over="ignore"):  # infinite coordinates are rejected later
            vertices = vertices * thing.scale
        advance(1)
        mended = mend(Arrays(vertices, triangles), loose)
        advance(2)
    except ConfigError as error:
        raise ConfigError(f"object '{thing.name}': file: {error}") from error
    except ValueError as error:
        raise ConfigError(f"object '{thing.name}': file: {thing.file}: {error}") from error
    return mended.arrays, report_of(mended, loose, thing.scale if thing.mesh is None else None)


def _about(mended: tuple[Arrays, MeshReport]) -> About:
    return About(mended[1], thin_mesh(mended[0]))


def _state(thing: schema.Mesh) -> Any:
    """Return a key that changes if the triangles of an object may have changed."""
    if thing.mesh is not None:
        return hashlib.sha256(_bytes(thing)).digest(), *_source(thing)
    try:
        status = os.stat(thing.file)
    except (OSError, ValueError):
        return None, *_source(thing)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, *_source(thing)


def _key(data: bytes, thing: schema.Mesh) -> str:
    """Return a hash of the file's bytes, its ending and scale, and the program's source."""
    digest = hashlib.sha256(data)
    made: tuple[Any, ...] = SOURCE_HASH, len(data), Path(thing.file).suffix.lower(), thing.scale
    if thing.elastic is not None:
        made = (*made, *(hashlib.sha256(array.tobytes()).digest() for array in _body(thing).surface))
    digest.update(repr(made).encode())
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
