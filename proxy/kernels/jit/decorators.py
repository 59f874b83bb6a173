"""Decorators that compile kernels: one set of options, and one cache that cannot return outdated code.

A kernel inlines code from other files and reads their constants, so it has to be compiled again after an edit of any of
them. The cache is therefore in a folder named by a hash over every source file of the folders with kernels, numba's
version and settings, and the processor: any change selects another folder. Kernels elsewhere, in `tools`, inline code
only from their folder and from these (`cache.py`). If this cache cannot be used, kernels are compiled in memory.

No `fastmath`: it breaks `isnan`, and contraction would let the servo and the offline run round differently.
`error_model="numpy"`: a division by zero gives inf or nan, which the guard rejects, instead of an exception, which
would end the loop.
"""

from __future__ import annotations

import gc
import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core import event

from softfinger.proxy.kernels.jit.cache import KERNEL_FOLDERS, Folder, hash_of_sources
from softfinger.proxy.kernels.jit.compiler.numba_internals import (
    FOR_KERNELS,
    WITHOUT_ALLOCATOR,
    WITHOUT_WRAPPERS,
    CFunction,
    InlinedKernel,
    KernelCache,
    UnitCompiler,
)
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

PLAIN: Final = bool(numba.config.DISABLE_JIT)
"""numba's switch, the environment variable NUMBA_DISABLE_JIT=1: kernels are plain Python functions, for a debugger, a
profiler or a coverage measurement. `Engine` then works with the same bits; functions that need machine code do not."""


def _cache_root() -> Path | None:
    """Return the root of all cache folders; None if the user's home folder is unknown."""
    named = os.environ.get("SOFTFINGER_CACHE_DIR")
    if named:
        return Path(named).absolute()
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "softfinger"
    except RuntimeError:
        return None


def _fingerprint() -> str:
    made = numba.config
    cpu = made.CPU_NAME or llvm.get_host_cpu_name()
    settings = made.OPT, made.BOUNDSCHECK, made.LOOP_VECTORIZE, made.SLP_VECTORIZE
    kernels = hash_of_sources(KERNEL_FOLDERS)
    return hashlib.sha256(f"{numba.__version__} {sys.version} {cpu} {settings} {kernels}".encode()).hexdigest()[:16]


_ROOT: Final = _cache_root()

CACHE_DIR: Final = None if _ROOT is None else _ROOT / _fingerprint()
"""Cache folder of this version's compiled kernels, None without one; `SOFTFINGER_CACHE_DIR` moves it."""

KERNEL_FOLDER: Final = Folder(CACHE_DIR)

OPTIONS: Final = {"error_model": "numpy", "nogil": True} | WITHOUT_ALLOCATOR | WITHOUT_WRAPPERS
"""Options of all kernels. No allocator and no reference counts: a kernel that would allocate does not compile. No C
wrappers: `c_function` generates those that are needed."""

INLINED: Final = OPTIONS | FOR_KERNELS
"""Options of a kernel that is called only by kernels: no Python wrapper, compiled into its callers."""


class _CompileListener(event.Listener):  # type: ignore[misc]
    """Listener for the start and end of each compilation by numba.

    The garbage collector is off until the end of the outermost compilation: numba creates millions of objects that live
    as long as it compiles, and scanning them repeatedly takes a seventh of the time. At the end they move to the oldest
    generation: the next collection of the youngest would scan them all, in a twentieth of the time.
    """

    def __init__(self) -> None:
        self._depth, self._collects = 0, False

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1
        COMPILE_PROGRESS.begin()

    def on_end(self, event: Any) -> None:
        COMPILE_PROGRESS.end()
        self._depth -= 1
        if self._depth > 0:
            return
        if self._collects:
            if gc.get_freeze_count() == 0:  # else the caller has frozen objects, which have to stay frozen
                gc.freeze()
                gc.unfreeze()
            gc.enable()


event.register("numba:compile", _CompileListener())


def jit(function: Kernel) -> Kernel:
    """Compile a kernel into its callers; use `outlined` for one that is too large for that."""
    if PLAIN:
        return function
    return cast(Kernel, InlinedKernel(function, INLINED, KernelCache(function, KERNEL_FOLDER, "inlined"), entry))


def entry(function: Kernel) -> Kernel:
    """Compile a kernel that is called from Python, and cache the result on disk."""
    if PLAIN:
        return function
    compiled: Any = numba.njit(pipeline_class=UnitCompiler, **OPTIONS)(function)
    compiled._cache = KernelCache(function, KERNEL_FOLDER)
    return cast(Kernel, compiled)


def c_function(signature: Any, on_demand: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Compile a kernel with a C address (`.address`), and cache the result on disk.

    on_demand  compile it on first access to the address, before the first tick: for kernels that few importers of a
               driver need
    """

    def decorate(function: Callable[..., Any]) -> Any:
        # Without a cache in plain Python: access to an address must fail, even with a cached function.
        compiled: Any = CFunction(function, signature, None if PLAIN else KernelCache(function, KERNEL_FOLDER, "c"))
        if not on_demand and not PLAIN:
            compiled.compile()
        return compiled

    return decorate
