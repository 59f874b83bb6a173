"""Progress of compilation and loading of kernels, for the status line of a waiting user.

Imports nothing of the compiler: a program that only waits for another does not need it. Only the
thread with numba's lock writes; a reader in another thread gets one state or the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class CompileProgress:
    """Kernels that this process compiles and loads."""

    def __init__(self) -> None:
        self._compiled = self._depth = self._estimate = 0
        self._loading = False
        self.on_first: Callable[[], None] | None = None
        """Callback at the start of the next compilation; loading does not call it."""

    def expect(self, estimate: int) -> None:
        """Count from 1 again; with an empty cache a scene compiles about `estimate` kernels."""
        self._compiled, self._estimate = 0, estimate

    def __str__(self) -> str:
        """Return `compiling kernel 2 (about 240 with an empty cache)`, `loading cached kernels`, or an empty string.

        The estimate is left out once it is exceeded.
        """
        if self._depth:  # its callees may be loaded at the same time
            number = self._compiled + 1
            estimate = f" (about {self._estimate} with an empty cache)" if number <= self._estimate else ""
            return f"compiling kernel {number}{estimate}"
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
