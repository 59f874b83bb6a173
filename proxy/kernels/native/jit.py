"""How kernels are compiled: one set of options, one cache that cannot serve stale code.

A kernel inlines code from other files and reads their constants, so it has to be compiled anew after an edit
of any of them. So the cache lives in a folder named by a hash over every source file of the folders that kernels are
written in, numba's version and settings and the processor: any change means another folder. Kernels elsewhere, those of
`tools`, take of their own folder and of those (`kept.py`). Where the cache cannot be used there is no other: kernels
are compiled in memory.

No `fastmath`: it makes `isnan` lie, and contraction would let the servo and the offline run round
differently. `error_model="numpy"`: a division by zero gives inf or nan, which the guard refuses,
rather than an exception, which would end the loop.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core import event, sigutils
from numba.core.ccallback import CFunc
from numba.core.registry import CPUDispatcher

from softfinger.proxy.kernels.native.compiler.doing import DOING
from softfinger.proxy.kernels.native.compiler.pipeline import KernelCompiler, PartCompiler
from softfinger.proxy.kernels.native.kept import KERNEL_FOLDERS, Folder, KernelCache

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

PLAIN: Final = bool(numba.config.DISABLE_JIT)
"""numba's own switch, the environment's NUMBA_DISABLE_JIT=1: kernels are plain Python functions, for a debugger, a
profiler or a measurement of coverage. `Engine` works so, bit for bit the same; what needs machine code does not."""

_PACKAGE: Final = Path(__file__).resolve().parents[3]
_SOURCE_FOLDERS: Final = ("config", "drivers", "proxy", "server", "tools")
_OWN_FILE: Final = "config/package.py"
"""Elsewhere in a wheel, which is to find the kernels of a clone of the same version, and the other way round."""


def _cache_root() -> Path | None:
    """None for a user whose home folder is not known."""
    named = os.environ.get("SOFTFINGER_CACHE_DIR")
    if named:
        return Path(named).absolute()
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "softfinger"
    except RuntimeError:
        return None


def _source_hash(folders: Iterable[str]) -> str:
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            if path != _PACKAGE / _OWN_FILE:
                digest.update(path.read_bytes())
    return digest.hexdigest()


SOURCE_HASH: Final = _source_hash(_SOURCE_FOLDERS)
"""What tells this version of the program from others: a hash over every source file as it was at import."""


def _fingerprint() -> str:
    made = numba.config
    cpu = made.CPU_NAME or llvm.get_host_cpu_name()
    settings = made.OPT, made.BOUNDSCHECK, made.LOOP_VECTORIZE, made.SLP_VECTORIZE
    kernels = _source_hash(KERNEL_FOLDERS)
    return hashlib.sha256(f"{numba.__version__} {sys.version} {cpu} {settings} {kernels}".encode()).hexdigest()[:16]


_ROOT: Final = _cache_root()

CACHE_DIR: Final = None if _ROOT is None else _ROOT / _fingerprint()
"""Where this version's compiled kernels are kept, None for nowhere; `SOFTFINGER_CACHE_DIR` moves it."""

KEPT: Final = Folder(CACHE_DIR)

OPTIONS: Final = {
    "error_model": "numpy",
    "nogil": True,
    "_nrt": False,
    "no_cfunc_wrapper": True,
    "pipeline_class": KernelCompiler,
}
"""Without numba's runtime (`_nrt`) there is no allocator and no reference count: a kernel that would
allocate does not compile. There are no C wrappers: `c_function` makes those that are called."""


INLINED: Final = OPTIONS | {"forceinline": True, "no_cpython_wrapper": True, "pipeline_class": PartCompiler}
"""Options of a kernel that only kernels call: it has no wrapper for Python, and no machine code of its own."""


class _Told(event.Listener):  # type: ignore[misc]
    """numba says when it begins to compile a function, and when it has ended."""

    def on_start(self, event: Any) -> None:
        DOING.begin()

    def on_end(self, event: Any) -> None:
        DOING.end()


event.register("numba:compile", _Told())


class _OnCall(CPUDispatcher):  # type: ignore[misc]
    """A kernel for other kernels. Called from Python it is compiled once more, with a wrapper for that, and kept."""

    def __call__(self, *args: Any) -> Any:
        if "_from_python" not in self.__dict__:
            self._from_python = entry(self.py_func)
        return self._from_python(*args)


def on_call(compiled: Any) -> Any:
    """A kernel compiled without a wrapper for Python, made one that Python may call all the same."""
    compiled.__class__ = _OnCall
    return compiled


def jit(function: Kernel) -> Kernel:
    """Compile a kernel into its callers; `outlined` is for what is too large for that."""
    return function if PLAIN else cast(Kernel, on_call(numba.njit(**INLINED)(function)))


def entry(function: Kernel) -> Kernel:
    """Compile a kernel that Python calls, and keep the result on disk."""
    if PLAIN:
        return function
    compiled: Any = numba.njit(**OPTIONS)(function)
    compiled._cache = KernelCache(function, KEPT)
    return cast(Kernel, compiled)


class _CFunction(CFunc):
    """A kernel with a C address, which is compiled when that is first asked for."""

    @property
    def address(self) -> int | None:
        if super().address is None:
            self.compile()
        return super().address

    def _compile_uncached(self) -> Any:
        """numba says nothing of these."""
        DOING.begin()
        try:
            return super()._compile_uncached()  # type: ignore[misc]
        finally:
            DOING.end()


def c_function(signature: Any, on_demand: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Compile a kernel with a C address (`.address`), and keep the result on disk.

    on_demand  not before the address is asked for: where few who import a driver need it, and all before the first tick
    """
    wanted = sigutils.normalize_signature(signature)

    def decorate(function: Callable[..., Any]) -> Any:
        # What numba.cfunc does, which offers no other cache than its own.
        options = {"error_model": "numpy"}
        compiled: Any = _CFunction(function, wanted, locals={}, options=options, pipeline_class=KernelCompiler)
        compiled._cache = KernelCache(function, KEPT)
        if not on_demand and not PLAIN:
            compiled.compile()
        return compiled

    return decorate
