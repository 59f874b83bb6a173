"""Display of the progress while a mesh or an elastic body is prepared, which takes seconds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext


def show_nothing(operation: str, total: int) -> AbstractContextManager[Callable[[int], None]]:
    """Show nothing. During the block of a display, calls of its result report the number done, out of `total`."""
    return nullcontext(lambda number: None)


display: Callable[[str, int], AbstractContextManager[Callable[[int], None]]] = show_nothing
"""Present display, called as a module attribute; the command line replaces it."""
