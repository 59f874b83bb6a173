"""Base class of objects with a `close` method that are context managers."""

from __future__ import annotations

from abc import ABC, abstractmethod
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
