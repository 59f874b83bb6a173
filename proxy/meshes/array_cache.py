"""Cache of arrays on disk, which are loaded in a small fraction of the time needed to compute them.

A file has a JSON header with a checksum, followed by the raw arrays, aligned to 64 bytes. The folder is checked for
write access by other users, as for compiled kernels. Type, shape and checksum of each array are compared with the
header. A file that fails any check is ignored.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import mmap
import os
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.cache import Folder, UntrustedCache
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR

MAGIC: Final = b"softfinger mesh 1\n"
HEAD_MAX: Final = 1 << 20
ALIGNMENT: Final = 64
BYTES_MAX: Final = 4 << 30
"""Size limit of the cache; beyond it, the least recently used files are removed. The largest mesh takes 2.5 GB."""
ENDING: Final = ".mesh"

FOLDER: Final = Folder(
    None if CACHE_DIR is None else CACHE_DIR.parent / "meshes", "meshes are not cached, so every start builds them"
)

_DTYPE: Final = re.compile("<[fiu][1248]|[|][iu]1")
_FIXED: Final = len(MAGIC) + hashlib.sha256().digest_size + 8

log: Final = logging.getLogger(__name__)


class CachedArrays(NamedTuple):
    """Arrays and plain values by name. Arrays loaded from disk are read-only."""

    arrays: Mapping[str, NDArray[Any]]
    values: Mapping[str, Any]


def load(key: str, folder: Folder = FOLDER) -> CachedArrays | None:
    """Return the entry of a key, or None if it is missing or damaged."""
    name = f"{key}{ENDING}"
    try:
        with folder.opened(name) as file:
            # Read, not mapped: later changes of the file must not affect a process that renders.
            memory = _allocate(os.fstat(file.fileno()).st_size)
            if file.readinto(memory) != len(memory):  # type: ignore[attr-defined]
                raise UntrustedCache("it is truncated")
            with contextlib.suppress(OSError):  # in another user's folder; only the time of last use is lost
                os.utime(file.fileno())
        return _read(key, memory)
    except FileNotFoundError:
        return None
    except (UntrustedCache, OSError, ValueError, TypeError, KeyError) as error:
        if folder.problem() is None:
            log.warning("cached mesh %s is invalid and is built again: %s", name, error)
        return None


def _allocate(size: int) -> mmap.mmap:
    """Return anonymous memory in huge pages, if the system has them.

    The kernel clears each page on its first write; with small pages that takes three quarters of the reading time.
    """
    memory = mmap.mmap(-1, max(1, size), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


def save(key: str, cached: CachedArrays, folder: Folder = FOLDER) -> None:
    """Store arrays, and values of JSON types, under a key, and remove the least recently used files over the limit.

    If the folder cannot be used, nothing is stored and the folder logs a warning, once.
    """
    folder.put(f"{key}{ENDING}", _iter_parts(key, cached))
    if folder.path is not None and folder.problem() is None:
        with contextlib.suppress(OSError):
            _make_room(folder, f"{key}{ENDING}")


def _iter_parts(key: str, cached: CachedArrays) -> Iterator[Any]:
    """Yield the contents of the file in pieces."""
    arrays = {name: np.ascontiguousarray(array) for name, array in cached.arrays.items()}
    at, table = 0, {}
    for name, array in arrays.items():
        table[name] = {"dtype": array.dtype.str, "shape": array.shape, "at": at, "sum": _sum(array)}
        at += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
    head = json.dumps({"key": key, "bytes": at, "arrays": table, "values": dict(cached.values)}).encode()
    head += b" " * (-(_FIXED + len(head)) % ALIGNMENT)
    yield MAGIC + hashlib.sha256(head).digest() + len(head).to_bytes(8, "little") + head
    for array in arrays.values():
        yield array.reshape(-1).view(np.uint8).data
        yield bytes(-array.nbytes % ALIGNMENT)


def _read(key: str, memory: mmap.mmap) -> CachedArrays:
    length = int.from_bytes(memory[_FIXED - 8 : _FIXED], "little")
    head = memory[_FIXED : _FIXED + min(length, HEAD_MAX)]
    if memory[: _FIXED - 8] != MAGIC + hashlib.sha256(head).digest():
        raise UntrustedCache("its head is damaged")
    header = json.loads(head)
    if header["key"] != key or len(memory) != _FIXED + length + header["bytes"]:
        raise UntrustedCache("it belongs to another mesh or is truncated")
    return CachedArrays(
        {name: _read_array(memory, _FIXED + length, entry) for name, entry in header["arrays"].items()},
        header["values"],
    )


def _read_array(memory: mmap.mmap, start: int, entry: Mapping[str, Any]) -> NDArray[Any]:
    if not _DTYPE.fullmatch(entry["dtype"]):
        raise UntrustedCache(f"it has an array of {entry['dtype']}")
    count = math.prod(entry["shape"])
    array = np.frombuffer(memory, entry["dtype"], count, start + entry["at"])
    if _sum(array) != entry["sum"]:
        raise UntrustedCache("its numbers are damaged")
    array.setflags(write=False)
    return array.reshape(entry["shape"])


def _sum(array: NDArray[Any]) -> int:
    """Return the sum of the 64-bit words modulo 2^64.

    Any single flipped bit changes it. Its computation is limited by memory bandwidth.
    """
    data = array.reshape(-1).view(np.uint8)
    whole = len(data) // 8 * 8
    remainder = int.from_bytes(data[whole:].tobytes(), "little")
    return (int(data[:whole].view(np.uint64).sum(dtype=np.uint64)) + remainder) % 2**64


def _make_room(folder: Folder, newest: str) -> None:
    assert folder.path is not None
    with os.scandir(folder.path) as entries:
        files = [(entry.stat().st_mtime_ns, entry.stat().st_size, entry.path) for entry in entries
                 if entry.name.endswith(ENDING) and entry.name != newest]  # fmt: skip
    room = BYTES_MAX - (folder.path / newest).stat().st_size
    for _, size, path in sorted(files, reverse=True):
        room -= size
        if room < 0:
            os.unlink(path)
