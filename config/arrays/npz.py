"""Arrays in npz and npy files of foreign origin, read in bounded memory whatever sizes they claim.

A npz file may be compressed: a few kilobytes of it can stand for gigabytes. Nothing is unpacked that is larger than
the caller asks for and the limits here, which no file of this program comes near.
"""

from __future__ import annotations

import io
import zipfile
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

DIRECTORY_BYTES_MAX: Final = 1 << 20
"""Of the list of arrays in an npz file; this program's has some 10 KB."""
HEADER_BYTES_MAX: Final = 1 << 16
"""Of the description in front of an array in an npz file; this program's has 128."""


def npy_array(data: bytes, what: str) -> NDArray[Any]:
    """The array of an npy file's bytes, not unpickled; ValueError naming `what`, or what numpy raises on damage.

    The bytes are there before their header is believed: it may claim any shape, and numpy would make room for it.
    """
    content = io.BytesIO(data)
    version = np.lib.format.read_magic(content)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, fortran, kind = read_header[version](content)
    if kind.hasobject:
        raise ValueError(f"{what} holds objects, must hold numbers")
    values = np.frombuffer(content.getbuffer(), kind, offset=content.tell())
    return values.reshape(shape, order="F" if fortran else "C")


class Npz:
    """The arrays of an npz file; none of them is unpickled."""

    def __init__(self, file: IO[bytes]) -> None:
        with _Sparing(file) as spared:
            self._archive = zipfile.ZipFile(spared)

    def names(self) -> list[str]:
        """Of the arrays in the file."""
        return [name.removesuffix(".npy") for name in self._archive.namelist() if name.endswith(".npy")]

    def array(self, name: str, bytes_max: int) -> NDArray[Any]:
        """An array of at most `bytes_max` bytes; ValueError for a larger one, else what the libraries raise."""
        member = self._archive.getinfo(f"{name}.npy")
        if member.file_size > bytes_max + HEADER_BYTES_MAX:
            raise ValueError(f"array '{name}' has {member.file_size:,} bytes, {bytes_max:,} are the most that are read")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others take memory at will
            raise ValueError(f"array '{name}' is compressed in a way that numpy does not write")
        with self._archive.open(member) as stream:
            return npy_array(stream.read(member.file_size), f"array '{name}'")


class _Sparing:
    """A file that hands out no more than DIRECTORY_BYTES_MAX at once while a zip archive's list is read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._spare = file, True

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self._spare = False

    def read(self, count: int = -1) -> bytes:
        if not self._spare:
            return self._file.read(count)
        data = self._file.read(DIRECTORY_BYTES_MAX + 1 if count < 0 else min(count, DIRECTORY_BYTES_MAX + 1))
        if len(data) > DIRECTORY_BYTES_MAX:
            raise ValueError(f"its list of arrays has more than {DIRECTORY_BYTES_MAX:,} bytes")
        return data

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
