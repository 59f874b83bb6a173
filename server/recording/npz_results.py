"""Writer of records as an .npz archive of columns."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Final
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.config.files import follow_links
from softfinger.proxy.record import FIELDS, RECORD_SIZE

CHUNK_ROWS: Final = 4096
"""Number of rows transposed at a time; they fit into the processor's cache."""


def make_prefix(finger: str) -> str:
    """Return the prefix of the names of a finger's columns and arrays."""
    return f"{finger}." if finger else ""


def write_npz(path: Path, file: IO[bytes], fingers: Sequence[str], blocks: Iterable[Array]) -> None:
    """Write for each finger an array per field, and all fields together as `records`.

    Only constant fields are compressed: varying float64 shrink little, and that would take most of the time. Arrays of
    an archive are stored in sequence, so the records are collected in an unnamed temporary file first.

    path    final path of the file; the temporary file is in its folder
    file    file to write
    blocks  records (m, fingers, RECORD_SIZE)
    """
    with (
        TemporaryFile(dir=follow_links(path).parent) as file_of_columns,
        ZipFile(file, "w", ZIP_STORED, compresslevel=1) as archive,
    ):
        columns = _Columns(file_of_columns, len(fingers))
        for block in blocks:
            columns.append(block)
        for index, finger in enumerate(fingers):
            for name, at, size in (("records", 0, RECORD_SIZE), *((f.name, f.at, f.size) for f in FIELDS)):
                shape = (columns.count, size)[: 2 if size > 1 else 1]
                part = slice(index * RECORD_SIZE + at, index * RECORD_SIZE + at + size)
                varies = bool(columns.varying[part].any())
                _add_array(archive, make_prefix(finger) + name, shape, columns.read(part), varies or name == "records")


class _Columns:
    """Records in an empty file, in blocks of CHUNK_ROWS, of each only the columns that vary so far.

    count    number of records
    varying  (fingers * RECORD_SIZE,) true for columns with different values, bit for bit
    """

    def __init__(self, file: IO[bytes], fingers: int) -> None:
        self._file, self._end = file, 0
        self._blocks: list[tuple[int, int, NDArray[np.int64]]] = []
        """Offset, number of rows and stored columns of each block."""
        self._first: Array = np.zeros(fingers * RECORD_SIZE)
        self.count = 0
        self.varying: NDArray[np.bool_] = np.zeros(fingers * RECORD_SIZE, bool)

    def append(self, block: Array) -> None:
        """Append a block (m, fingers, RECORD_SIZE)."""
        rows = block.reshape(len(block), -1)
        if not self.count and len(rows):
            self._first = rows[0].copy()
        for start in range(0, len(rows), CHUNK_ROWS):
            columns = np.ascontiguousarray(rows[start : start + CHUNK_ROWS].T)
            self.varying |= (columns.view(np.int64) != self._first.view(np.int64)[:, None]).any(axis=1)
            stored = self.varying.nonzero()[0]
            self._blocks.append((self._end, columns.shape[1], stored))
            self._file.write(columns[stored].data)
            self._end += 8 * columns.shape[1] * len(stored)
            self.count += columns.shape[1]
        self._file.flush()

    def read(self, part: slice) -> Iterator[Array]:
        """Yield these columns of each block, (m, size)."""
        for offset, length, stored in self._blocks:
            first, last = np.searchsorted(stored, (part.start, part.stop)).tolist()
            values = np.empty((length, part.stop - part.start))
            values[:] = self._first[part]
            data = os.pread(self._file.fileno(), 8 * length * (last - first), offset + 8 * length * first)
            values[:, stored[first:last] - part.start] = np.frombuffer(data).reshape(last - first, length).T
            yield values


def _add_array(
    archive: ZipFile, name: str, shape: tuple[int, ...], blocks: Iterable[Array], varies: bool = True
) -> None:
    info = ZipInfo(f"{name}.npy", time.localtime()[:6])
    info.compress_type = ZIP_STORED if varies else ZIP_DEFLATED
    with archive.open(info, "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": shape})
        for block in blocks:
            member.write(block.data.cast("B"))
