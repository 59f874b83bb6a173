"""A maker's C library, found at run time: opened, and each function of it declared before the first call."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.config.files import expanded


class MakersLibrary(NamedTuple):
    """A library as a driver knows it.

    name        in messages
    sonames     what the loader is asked for last
    prototypes  result and parameters of every function used
    advice      where to get it
    needs       why a file that is there cannot be loaded
    version     to take, where a function is missing
    """

    name: str
    sonames: tuple[str, ...]
    prototypes: Mapping[str, tuple[Any, tuple[Any, ...]]]
    advice: str
    needs: str
    version: str


def load(library: MakersLibrary, named: str | None, patterns: Sequence[Path], note: str = "") -> ctypes.CDLL:
    """The library, from the file `named` or from where it is usually put, with every prototype declared.

    patterns  where it may be, in the order in which it is looked for; the last part of each is a pattern
    note      said where it is nowhere, behind the places

    Raises DeviceNotFound when it is nowhere, with each place looked in, and DeviceError when a file is there but
    cannot be used.
    """
    if named is not None:
        path = expanded(named)
        if not os.path.isfile(path):  # also where this user may not look
            raise DeviceNotFound(f"library_file = '{named}': there is no such file; {library.advice}")
        return _opened(library, str(path))
    for pattern in patterns:
        # The longest name has the whole version in it; of several versions the newest sorts last.
        for path in sorted(pattern.parent.glob(pattern.name), key=lambda p: (len(p.name), p.name), reverse=True):
            return _opened(library, str(path))
    for name in library.sonames:
        try:
            return _declared(library, ctypes.CDLL(name), name)
        except OSError:
            continue
    looked = ", ".join([*map(str, patterns), *(f"{name} by the loader" for name in library.sonames)])
    raise DeviceNotFound(f"{library.name} is not on this machine: looked for {looked}{note}; {library.advice}")


def address(library: ctypes.CDLL, name: str) -> int:
    """Address of a function for the loop."""
    return ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0


def _opened(library: MakersLibrary, path: str) -> ctypes.CDLL:
    try:
        found = ctypes.CDLL(path)
    except OSError as error:
        raise DeviceError(f"{path} cannot be loaded: {error}: {library.needs}") from error
    return _declared(library, found, path)


def _declared(library: MakersLibrary, found: ctypes.CDLL, path: str) -> ctypes.CDLL:
    for name, (result, parameters) in library.prototypes.items():
        try:
            function = getattr(found, name)
        except AttributeError:
            raise DeviceError(f"{path} has no function {name}: take {library.version}") from None
        function.restype, function.argtypes = result, list(parameters)
    return found
