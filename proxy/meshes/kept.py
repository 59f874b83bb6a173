"""Arrays on disk, found again in a small part of the time that they take to compute.

A file has a head of JSON, with a checksum, and behind it the arrays as they lie in memory, 64 bytes apart. Who else
may write to the folder is looked at as for compiled kernels; what the head says of each array, and the sum of its
words, is held against what is there. A file that fails in any of this is not used.
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

from softfinger.proxy.kernels.jit.cache import Folder, Unsound
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR

MAGIC: Final = b"softfinger mesh 1\n"
HEAD_MAX: Final = 1 << 20
ALIGNED: Final = 64
BYTES_MAX: Final = 4 << 30
"""Of all that is kept; past it what was not used for longest goes. The largest mesh has 2.5 GB."""
ENDING: Final = ".mesh"

KEPT: Final = Folder(
    None if CACHE_DIR is None else CACHE_DIR.parent / "meshes", "meshes are not kept, so every start builds them"
)

_DTYPE: Final = re.compile("<[fiu][1248]|[|][iu]1")
_FIXED: Final = len(MAGIC) + hashlib.sha256().digest_size + 8

log: Final = logging.getLogger(__name__)


class Kept(NamedTuple):
    """Arrays and plain values, each by name. Arrays that come from disk are read-only."""

    arrays: Mapping[str, NDArray[Any]]
    values: Mapping[str, Any]


def load(key: str, folder: Folder = KEPT) -> Kept | None:
    """What was kept under a key; None if it is not there, or damaged."""
    name = f"{key}{ENDING}"
    try:
        with folder.opened(name) as file:
            # Read, not mapped: what becomes of the file later is nothing to a process that renders.
            seen = _room(os.fstat(file.fileno()).st_size)
            if file.readinto(seen) != len(seen):  # type: ignore[attr-defined]
                raise Unsound("it was cut off")
            with contextlib.suppress(OSError):  # of another user's folder only its age is lost
                os.utime(file.fileno())
        return _read(key, seen)
    except FileNotFoundError:
        return None
    except (Unsound, OSError, ValueError, TypeError, KeyError) as error:
        if folder.problem() is None:
            log.warning("kept mesh %s is not used but built anew: %s", name, error)
        return None


def _room(size: int) -> mmap.mmap:
    """Memory in huge pages, where the system has them: a page is cleared when it is first written to, and in small ones
    that takes three quarters of the time of reading."""
    room = mmap.mmap(-1, max(1, size), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without them
        room.madvise(mmap.MADV_HUGEPAGE)
    return room


def save(key: str, kept: Kept, folder: Folder = KEPT) -> None:
    """Keep arrays and values of JSON under a key, if that can be; what was not used for longest makes room."""
    folder.put(f"{key}{ENDING}", _parts(key, kept))
    if folder.path is not None and folder.problem() is None:
        with contextlib.suppress(OSError):
            _make_room(folder, f"{key}{ENDING}")


def _parts(key: str, kept: Kept) -> Iterator[Any]:
    """The file, piece by piece."""
    arrays = {name: np.ascontiguousarray(array) for name, array in kept.arrays.items()}
    at, table = 0, {}
    for name, array in arrays.items():
        table[name] = {"dtype": array.dtype.str, "shape": array.shape, "at": at, "sum": _sum(array)}
        at += -(-array.nbytes // ALIGNED) * ALIGNED
    head = json.dumps({"key": key, "bytes": at, "arrays": table, "values": dict(kept.values)}).encode()
    head += b" " * (-(_FIXED + len(head)) % ALIGNED)
    yield MAGIC + hashlib.sha256(head).digest() + len(head).to_bytes(8, "little") + head
    for array in arrays.values():
        yield array.reshape(-1).view(np.uint8).data
        yield bytes(-array.nbytes % ALIGNED)


def _read(key: str, seen: mmap.mmap) -> Kept:
    length = int.from_bytes(seen[_FIXED - 8 : _FIXED], "little")
    head = seen[_FIXED : _FIXED + min(length, HEAD_MAX)]
    if seen[: _FIXED - 8] != MAGIC + hashlib.sha256(head).digest():
        raise Unsound("its head is damaged")
    said = json.loads(head)
    if said["key"] != key or len(seen) != _FIXED + length + said["bytes"]:
        raise Unsound("it is another's, or was cut off")
    return Kept({name: _array(seen, _FIXED + length, each) for name, each in said["arrays"].items()}, said["values"])


def _array(seen: mmap.mmap, start: int, said: Mapping[str, Any]) -> NDArray[Any]:
    if not _DTYPE.fullmatch(said["dtype"]):
        raise Unsound(f"it has an array of {said['dtype']}")
    count = math.prod(said["shape"])
    array = np.frombuffer(seen, said["dtype"], count, start + said["at"])
    if _sum(array) != said["sum"]:
        raise Unsound("its numbers are damaged")
    array.setflags(write=False)
    return array.reshape(said["shape"])


def _sum(array: NDArray[Any]) -> int:
    """The sum of its words modulo 2^64: no flipped bit leaves it as it was, and memory is no faster."""
    data = array.reshape(-1).view(np.uint8)
    whole = len(data) // 8 * 8
    rest = int.from_bytes(data[whole:].tobytes(), "little")
    return (int(data[:whole].view(np.uint64).sum(dtype=np.uint64)) + rest) % 2**64


def _make_room(folder: Folder, newest: str) -> None:
    assert folder.path is not None
    with os.scandir(folder.path) as found:
        files = [(each.stat().st_mtime_ns, each.stat().st_size, each.path) for each in found
                 if each.name.endswith(ENDING) and each.name != newest]  # fmt: skip
    room = BYTES_MAX - (folder.path / newest).stat().st_size
    for _, size, path in sorted(files, reverse=True):
        room -= size
        if room < 0:
            os.unlink(path)
