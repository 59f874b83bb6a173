"""Progress of compiling and loading kernels, for the progress line.

Imports nothing of the compiler, because a program that only waits for another process does not need it. A thread that
compiles or loads holds numba's lock, so there is one writer; readers are in other threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class CompileProgress:
    """Progress of the kernels that this process compiles or loads from the disk."""

    def __init__(self) -> None:
        self._compiled = self._depth = 0
        self._loading = False
        self.on_first: Callable[[], None] | None = None
        """Called before the first kernel of this process is compiled; not for kernels that are loaded."""

    def __str__(self) -> str:
        """Return `compiling kernel 2` (the second of this process), `loading kept kernels`, or an empty text."""
        if self._depth:  # kernels that it calls may be loaded meanwhile
            return f"compiling kernel {self._compiled}"
        return "loading kept kernels" if self._loading else ""

    def begin(self) -> None:
        """Count a kernel; kernels compiled while it is compiled are part of it."""
        if not self._compiled and self.on_first is not None:
            self.on_first()
        self._compiled += not self._depth
        self._depth += 1

    def end(self) -> None:
        self._depth -= 1

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Report loading while the block searches and loads a kernel."""
        self._loading = True
        try:
            yield
        finally:
            self._loading = False


COMPILE_PROGRESS = CompileProgress()
