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
        self._compiled = self._depth = self._at_most = 0
        self._loading = False
        self.on_first: Callable[[], None] | None = None
        """Callback at the start of the next compilation; loading does not call it."""

    def expect(self, at_most: int) -> None:
        """Count from 1 again, towards the number of kernels that a scene compiles with an empty cache."""
        self._compiled, self._at_most = 0, at_most

    def __str__(self) -> str:
        """Return `compiling kernel 2 of at most 240`, `loading cached kernels`, or an empty string."""
        if self._depth:  # its callees may be loaded at the same time
            number = self._compiled + 1
            return f"compiling kernel {number}" + (f" of at most {self._at_most}" if number <= self._at_most else "")
        return "loading cached kernels" if self._loading else ""

    def begin(self) -> None:
        """Record the start of a compilation; callees are compiled within that of their caller."""
        if self.on_first is not None:
            notify, self.on_first = self.on_first, None
            notify()
        self._depth += 1

    def end(self) -> None:
        self._depth -= 1
        self._compiled += 1

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Mark the duration of loading a kernel from disk."""
        self._loading = True
        try:
            yield
        finally:
            self._loading = False


COMPILE_PROGRESS = CompileProgress()
