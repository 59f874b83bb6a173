"""Reader of a grid of numbers in a file that a scene names: .npy, .npz, .csv, or a grey picture as .pgm or .png."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, Final, cast

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.files import open_input, read_input
from softfinger.config.words import format_value


def open_npz(file: IO[bytes]) -> NpzFile:
    """Open an npz file; each array is read on access. Raises ValueError, or NumPy's error, for other files."""
    if not zipfile.is_zipfile(file):  # numpy would take it for a pickle and explain how to load one
        raise ValueError("is not an archive of arrays written by numpy.savez")
    file.seek(0)
    return cast(NpzFile, np.load(file, allow_pickle=False))


Grid = NDArray[np.float64]

NUMBER_BYTES_MAX: Final = 32
"""Largest size of one number: float64 has 8 bytes, its full text 24 and a comma; no NumPy number has more than 32."""
HEAD_BYTES_MAX: Final = 1 << 16
"""Largest size of the header before the numbers; NumPy writes 128 bytes."""
BYTES_MAX: Final = int(limits.GRID_VALUES.high) * NUMBER_BYTES_MAX + HEAD_BYTES_MAX
MAGNITUDE_MAX: Final = 1e100
"""Largest magnitude of a number; the difference of far larger numbers would overflow float64."""

_GAP: Final = rb"\s+(?:#[^\n]*\n\s*)*"
_PGM: Final = re.compile(_GAP.join((rb"P5", rb"([0-9]{1,7})", rb"([0-9]{1,7})", rb"([0-9]{1,5})")) + rb"\s")
GREY: Final = ("L", "I;16", "I;16B", "I")
"""Pillow's modes of grey pictures with 8 and 16 bits."""
_PGM_HEAD_MAX: Final = 4096
"""Largest header of a PGM picture with its comments, bytes; GIMP writes about 60."""


def read_grid(path: str | Path, even: bool = False) -> Grid:
    """Read the numbers of a file.

    Parameters
    ----------
    path
        File with a suffix in `READERS`.
    even
        Accept a grid in which all values are equal.

    Returns
    -------
    Grid
        Finite numbers, (rows, columns).

    Raises
    ------
    ConfigError
        With the file, the fault and the remedy.
    """
    read = READERS.get(Path(path).suffix.lower())
    if read is None:
        raise ConfigError(
            f"{path}: must be one of {', '.join(READERS)}: save a picture as grey .png, or any array by "
            "numpy.save(name, array)"
        )
    try:
        values = read(path)
        if values.dtype.kind not in "fiub":
            raise ValueError(f"contains {values.dtype}, must contain numbers")
        grid = np.array(values[None] if values.ndim == 1 else values, dtype=np.float64)
        _check(grid, even)
    except (OSError, MemoryError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ConfigError(f"{path}: cannot be read: {reason}") from error
    except Exception as error:  # zip and npy decoders fail in many ways on damaged bytes
        raise ConfigError(f"{path}: {error}") from error
    return grid


def _check(grid: Grid, even: bool) -> None:
    if grid.ndim != 2 or grid.size == 0:
        raise ValueError(
            f"an array of shape {grid.shape}: must have rows and columns; select one channel of a colour picture"
        )
    if grid.size > limits.GRID_VALUES.high:
        raise ValueError(
            f"has {grid.size:,} values, at most {limits.GRID_VALUES.high:,} are allowed: {limits.GRID_VALUES[2]}"
        )
    bad = ~(np.abs(grid) <= MAGNITUDE_MAX)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(f"row {row}, column {column}: {grid[row, column]}: must be finite and at most 1e100")
    if grid.size < limits.GRID_VALUES.low:
        raise ValueError("has a single value: must have at least two")
    if not even and grid.min() == grid.max():
        raise ValueError(f"every value is {grid.flat[0]:g}: a texture has at least two")


def _read_npy(path: str | Path) -> NDArray[Any]:
    with open_input(path, BYTES_MAX) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _read_npz(path: str | Path) -> NDArray[Any]:
    with open_input(path, BYTES_MAX) as file:
        archive = open_npz(file)
        if len(archive.files) != 1:
            raise ValueError(
                f"has the arrays {', '.join(archive.files) or '(none)'}: must have one; save only that one"
            )
        return np.asarray(archive[archive.files[0]])


def _read_csv(path: str | Path) -> NDArray[Any]:
    lines = read_input(path, BYTES_MAX).decode("utf-8-sig").splitlines()
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not numbered:
        raise ValueError("has no numbers: write one row per line, with commas between the numbers")
    width = numbered[0][1].count(",") + 1
    grid = np.empty((len(numbered), width))
    for row, (number, line) in enumerate(numbered):
        cells = line.split(",")
        if len(cells) != width:
            raise ValueError(
                f"line {number} has {len(cells)} numbers, the first row {width}: all rows must have the same length"
            )
        try:
            grid[row] = [float(cell) for cell in cells]
        except ValueError as error:
            text = format_value(line.strip()[:40])
            raise ValueError(f"line {number}: {text}: must be numbers with points, and commas between them") from error
    return grid


def _read_pgm(path: str | Path) -> NDArray[Any]:
    data = read_input(path, BYTES_MAX)
    head = _PGM.match(data[:_PGM_HEAD_MAX])
    if head is None:
        raise ValueError("is not a binary grey picture (P5): export it as raw PGM")
    columns, rows, white = (int(group) for group in head.groups())
    if not 0 < white < 65536:
        raise ValueError(f"gives {white}: must be 1 to 65535")
    kind = np.dtype(np.uint8 if white < 256 else ">u2")
    available, needed = len(data) - head.end(), rows * columns * kind.itemsize
    if available != needed:
        raise ValueError(f"has {available:,} bytes of pixel data: {columns} x {rows} need {needed:,}")
    return np.frombuffer(data, kind, offset=head.end()).reshape(rows, columns)


def _read_png(path: str | Path) -> NDArray[Any]:
    """Return the grey levels as stored in the file, 0 to 255 or to 65535."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as missing:
        raise ValueError(
            f"Pillow is not installed ({missing}): pip install 'softfinger[pictures]', or save it as grey .pgm"
        ) from missing
    try:
        opened = Image.open(io.BytesIO(read_input(path, BYTES_MAX)), formats=["PNG"])
    except UnidentifiedImageError as error:  # its text has the address of an object
        raise ValueError("is not a PNG picture") from error
    with opened as picture:
        columns, rows = picture.size
        if columns * rows > limits.GRID_VALUES.high:  # before decompression
            raise ValueError(
                f"has {columns} x {rows} pixels, at most {limits.GRID_VALUES.high:,} are allowed: "
                f"{limits.GRID_VALUES[2]}"
            )
        if picture.mode not in GREY:
            raise ValueError(f"has pixels of {picture.mode}, must be grey without transparency, of 8 or 16 bits")
        return np.asarray(picture)


READERS: Final[dict[str, Callable[[str | Path], NDArray[Any]]]] = {
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".csv": _read_csv,
    ".pgm": _read_pgm,
    ".png": _read_png,
}
"""Reader of each file suffix."""
