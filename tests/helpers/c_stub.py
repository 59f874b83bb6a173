"""Stubs for vendor libraries in C: compiled by the test, controlled by named variables."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
NO_COMPILER = "the stub for the maker's library is C, and there is no compiler (cc, gcc, clang) to build it"


def compile_stub(source: Path, path: Path, *flags: str) -> Path:
    """Compile a C file to a shared library at `path`."""
    always = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *always, *flags, "-o", str(path), str(source), "-lm"], check=True)
    return path


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
