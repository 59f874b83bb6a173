"""Archives of arrays, opened by numpy; nothing in them is unpickled."""

from __future__ import annotations

import zipfile
from typing import IO, cast

import numpy as np
from numpy.lib.npyio import NpzFile


def open_npz(file: IO[bytes]) -> NpzFile:
    """The arrays of an npz file, each read when it is asked for. ValueError, or what numpy raises, for other files."""
    if not zipfile.is_zipfile(file):  # numpy would take it for a pickle, and say how to load one
        raise ValueError("is no archive of arrays, as numpy.savez writes it")
    file.seek(0)
    return cast(NpzFile, np.load(file, allow_pickle=False))
