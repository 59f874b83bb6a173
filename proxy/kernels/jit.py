"""How kernels are compiled: one set of options, one cache that cannot serve stale code.

numba keys its cache by the file a kernel stands in. A kernel that inlines code from another file,
or that reads a module constant, would keep running the old code after an edit. So the cache lives
in a directory named by a hash over every source file of this package, numba's version and the
processor: any change means another directory.

No `fastmath`: it makes `isnan` lie, and contraction would let the servo and the offline run round
differently. `error_model="numpy"`: a division by zero gives inf or nan, which the guard refuses,
rather than an exception, which would end the loop.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import llvmlite.binding as llvm
import numba
from numba.core.registry import CPUDispatcher

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_PACKAGE: Final = Path(__file__).resolve().parents[2]
_SOURCE_FOLDERS: Final = ("config", "drivers", "proxy", "server", "tools")


def _cache_root() -> Path:
    named = os.environ.get("SOFTFINGER_CACHE_DIR")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "softfinger"


def _source_hash() -> str:
    digest = hashlib.sha256()
    for folder in _SOURCE_FOLDERS:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


SOURCE_HASH: Final = _source_hash()
"""What tells this version of the program from others: a hash over every source file as it was at import."""


def _fingerprint() -> str:
    cpu = numba.config.CPU_NAME or llvm.get_host_cpu_name()
    return hashlib.sha256(f"{numba.__version__} {sys.version} {cpu} {SOURCE_HASH}".encode()).hexdigest()[:16]


CACHE_DIR: Final = _cache_root() / _fingerprint()
"""Where this version's compiled kernels are kept; `SOFTFINGER_CACHE_DIR` moves it."""

OPTIONS: Final = {"error_model": "numpy", "nogil": True, "_nrt": False, "no_cfunc_wrapper": True}
"""Without numba's runtime (`_nrt`) there is no allocator and no reference count: a kernel that would
allocate does not compile. There are no C wrappers: `c_function` makes those that are called."""


INLINED: Final = OPTIONS | {"forceinline": True, "no_cpython_wrapper": True}
"""Options of a kernel that only kernels call: without a wrapper for Python it compiles in half the time."""


class _Inlined(CPUDispatcher):  # type: ignore[misc]
    """A kernel compiled into its callers. Called from Python it is compiled once more, with the wrapper that needs."""

    def __call__(self, *args: Any) -> Any:
        if "_from_python" not in self.__dict__:
            self._from_python = numba.njit(**OPTIONS)(self.py_func)
        return self._from_python(*args)


def jit(function: Kernel) -> Kernel:
    """Compile a kernel into its callers."""
    compiled: Any = numba.njit(**INLINED)(function)
    compiled.__class__ = _Inlined
    return compiled


def _cached(make: Callable[..., Any], *args: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(CACHE_DIR)
        try:
            return make(*args, cache=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return decorate


def entry(function: Kernel) -> Kernel:
    """Compile a kernel that Python calls, and keep the result on disk."""
    compiled: Kernel = _cached(numba.njit, **OPTIONS)(function)
    return compiled


def c_function(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a kernel with a C address (`.address`), and keep the result on disk."""
    return _cached(numba.cfunc, signature, error_model="numpy")
