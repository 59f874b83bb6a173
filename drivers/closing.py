"""Base class of objects with a `close` method that are context managers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Closeable(ABC):
    """Context manager that returns the object and closes it at the end of the block, also after an error."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources; may be called repeatedly."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
