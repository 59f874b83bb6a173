"""Stand-ins for makers' libraries, in C: compiled by the test, and steered by names."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
NO_COMPILER = "the stand-in for the maker's library is C, and there is no compiler (cc, gcc, clang) to build it"


def compile_stub(source: Path, path: Path, *flags: str) -> Path:
    """A C file as a shared library at `path`."""
    always = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *always, *flags, "-o", str(path), str(source), "-lm"], check=True)
    return path


class CStub:
    """A library as tests steer it: `stub["fail_read"] = 0`, `stub["frames"]`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._library = ctypes.CDLL(str(path))  # the very library that the driver loads: one file, one state
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
