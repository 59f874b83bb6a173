"""Stubs for vendor libraries in C: compiled by the test, controlled by named variables."""

import ctypes
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest

COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
NO_COMPILER = "the stub for a library is C, and there is no compiler (cc, gcc, clang) to build it"


def compile_stub(source: Path, path: Path, *flags: str) -> Path:
    """Compile a C file to a shared library at `path`."""
    always = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *always, *flags, "-o", str(path), str(source), "-lm"], check=True)
    return path


@cache
def folder() -> tempfile.TemporaryDirectory[str]:
    """Return a folder for stubs that any user may enter, removed at exit."""
    made = tempfile.TemporaryDirectory(prefix="stubs-")
    os.chmod(made.name, 0o755)
    return made


@cache
def compiled(source: Path, name: str, *flags: str) -> Path:
    """Return the library of a stub, compiled at the first call; skip the test if there is no compiler."""
    if COMPILER is None:
        pytest.skip(NO_COMPILER)
    return compile_stub(source, Path(folder().name) / name, *flags)


class CStub:
    """Access to the variables of a stub library: `stub["fail_read"] = 0`, `stub["frames"]`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._library = ctypes.CDLL(str(path))  # the same file that the driver loads, so both share its state
        self._library.stub_get.restype = ctypes.c_double
        self._library.stub_set.argtypes = [ctypes.c_char_p, ctypes.c_double]

    def __getitem__(self, name: str) -> float:
        return float(self._library.stub_get(name.encode()))

    def __setitem__(self, name: str, value: float) -> None:
        self._library.stub_set(name.encode(), value)

    def update(self, **values: float) -> None:
        for name, value in values.items():
            self[name] = value

    def reset(self) -> None:
        self._library.stub_reset()
