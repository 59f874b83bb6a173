"""Release of resources: a base class of objects with a `close` method, and a context that undoes a failed opening."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self


class Closeable(ABC):
    """Context manager that returns the object and closes it at the end of the block, also after an error."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources; may be called repeatedly."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def undo_on_error(undo: Callable[[], object]) -> Iterator[None]:
    """Call `undo` if the block raises any exception, which then propagates."""
    try:
        yield
    except BaseException:
        undo()
        raise
