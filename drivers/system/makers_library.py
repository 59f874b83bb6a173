"""C library of a maker, found at run time and opened, with prototypes declared before the first call."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.config.files import expand_home


class MakersLibrary(NamedTuple):
    """Properties of a maker's library.

    name        for messages
    sonames     names to try with the loader, after all files
    prototypes  result and parameters of every function used
    advice      source of the library, for messages
    needs       reason why an existing file cannot be loaded, for messages
    version     version to install if a function is missing
    """

    name: str
    sonames: tuple[str, ...]
    prototypes: Mapping[str, tuple[Any, tuple[Any, ...]]]
    advice: str
    needs: str
    version: str


def load(library: MakersLibrary, file: str | None, patterns: Sequence[Path], note: str = "") -> ctypes.CDLL:
    """Load the library from `file` or from its usual places, and declare every prototype.

    patterns  places to search, in order; the last part of each is a glob pattern
    note      appended to the list of searched places in the message

    Raises DeviceNotFound, with every place searched, if no file exists, and DeviceError if a file cannot be used.
    """
    if file is not None:
        path = expand_home(file)
        if not os.path.isfile(path):  # also if this user may not read the folder
            raise DeviceNotFound(f"library_file = '{file}': the file does not exist; {library.advice}")
        return _open(library, str(path))
    for pattern in patterns:
        # The longest name contains the full version; the latest version sorts last.
        for path in sorted(pattern.parent.glob(pattern.name), key=lambda p: (len(p.name), p.name), reverse=True):
            return _open(library, str(path))
    for name in library.sonames:
        try:
            return _declare_prototypes(library, ctypes.CDLL(name), name)
        except OSError:
            continue
    searched = ", ".join([*map(str, patterns), *(f"{name} by the loader" for name in library.sonames)])
    raise DeviceNotFound(f"{library.name} was not found: searched for {searched}{note}; {library.advice}")


def find_address(library: ctypes.CDLL, name: str) -> int:
    return ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0


def _open(library: MakersLibrary, path: str) -> ctypes.CDLL:
    try:
        loaded = ctypes.CDLL(path)
    except OSError as error:
        raise DeviceError(f"{path} cannot be loaded: {error}: {library.needs}") from error
    return _declare_prototypes(library, loaded, path)


def _declare_prototypes(library: MakersLibrary, loaded: ctypes.CDLL, path: str) -> ctypes.CDLL:
    for name, (result, parameters) in library.prototypes.items():
        try:
            function = getattr(loaded, name)
        except AttributeError:
            raise DeviceError(f"{path} has no function {name}: install {library.version}") from None
        function.restype, function.argtypes = result, list(parameters)
    return loaded
