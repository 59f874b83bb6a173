"""What is done with kernels just now, for the line that a user waits with.

Nothing of the compiler is imported: a program that only waits for another has no use for it. Whoever compiles or loads
holds numba's lock, so there is one writer; a reader in another thread sees now this word, now that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Doing:
    """Kernels that this process compiles, and loads from the disk."""

    def __init__(self) -> None:
        self._compiled = self._depth = 0
        self._loading = False
        self.at_first: Callable[[], None] | None = None
        """Called when the first kernel of this process begins to be compiled, not for those that are loaded."""

    def __str__(self) -> str:
        """`compiling kernel 2`, the second of this process; `loading kept kernels`; or nothing."""
        if self._depth:  # others that it calls may be loaded meanwhile
            return f"compiling kernel {self._compiled}"
        return "loading kept kernels" if self._loading else ""

    def begin(self) -> None:
        """A kernel begins to be compiled; one that it calls, while it is, counts as part of it."""
        if not self._compiled and self.at_first is not None:
            self.at_first()
        self._compiled += not self._depth
        self._depth += 1

    def end(self) -> None:
        self._depth -= 1

    @contextmanager
    def loading(self) -> Iterator[None]:
        """While a kernel is looked for on the disk, and made ready."""
        self._loading = True
        try:
            yield
        finally:
            self._loading = False


DOING = Doing()
