"""Progress of compilation and loading of kernels, for the status line of a waiting user.

Imports nothing of the compiler: a program that only waits for another does not need it. A thread that compiles or loads
holds numba's lock, so there is one writer; a reader in another thread gets one state or the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class CompileProgress:
    """Kernels that this process compiles and loads."""

    def __init__(self) -> None:
        self._compiled = self._depth = 0
        self._loading = False
        self.on_first: Callable[[], None] | None = None
        """Callback at the start of the first compilation in this process; loading does not call it."""

    def __str__(self) -> str:
        """Return `compiling kernel 2` for the second of this process, `loading cached kernels`, or an empty string."""
        if self._depth:  # its callees may be loaded at the same time
            return f"compiling kernel {self._compiled}"
        return "loading cached kernels" if self._loading else ""

    def begin(self) -> None:
        """Record the start of a compilation; a nested one, of a callee, counts as part of it."""
        if not self._compiled and self.on_first is not None:
            self.on_first()
        self._compiled += not self._depth
        self._depth += 1

    def end(self) -> None:
        self._depth -= 1

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Mark the duration of loading a kernel from disk."""
        self._loading = True
        try:
            yield
        finally:
            self._loading = False


COMPILE_PROGRESS = CompileProgress()
