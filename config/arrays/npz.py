"""NumPy archives of arrays, opened without unpickling."""

from __future__ import annotations

import zipfile
from typing import IO, cast

import numpy as np
from numpy.lib.npyio import NpzFile


def open_npz(file: IO[bytes]) -> NpzFile:
    """Open an npz file; each array is read on access. Raises ValueError, or NumPy's error, for other files."""
    if not zipfile.is_zipfile(file):  # numpy would take it for a pickle and explain how to load one
        raise ValueError("is not an archive of arrays written by numpy.savez")
    file.seek(0)
    return cast(NpzFile, np.load(file, allow_pickle=False))
