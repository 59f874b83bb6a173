"""The rings of a servo's loops, one after the other, for the one reader of its records."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.server.loop.shared.bell import wait_for
from softfinger.server.loop.shared.ring import Feed, Ring, take


class Rings:
    """The ring that is read, and behind it that of the next loop where it has another.

    The servo's thread adds and turns; everything else is for the reader, in one thread. Use: `wait`, then `take` again
    and again until it returns 0; or `feeds`, for a reader without Python.
    """

    def __init__(self) -> None:
        self.wake_fd = os.eventfd(0)
        """Written after each record, and after each turn."""
        self._turns: Final = np.zeros(8, np.int64)
        self._rings: Final = list[Ring]()
        self._dropped = 0

    @property
    def newest(self) -> Ring | None:
        """That of the loop that runs, or ran last."""
        return self._rings[-1] if self._rings else None

    @property
    def drops(self) -> int:
        """Records that found no room."""
        return self._dropped + int(self._rings[0].drops[0])

    def add(self, ring: Ring) -> None:
        """The ring of a loop that begins, unless it goes on with that of the one before."""
        if ring is self.newest:
            return
        self._rings.append(ring)
        if len(self._rings) > 1:
            self._turns[0] += 1

    def end(self) -> None:
        """No record comes any more."""
        self._turns[0] += 1
        os.eventfd_write(self.wake_fd, 1)

    def wait(self) -> None:
        """Sleep until there is a record to take, or none comes any more."""
        wait_for(self.wake_fd)

    def take(self, out: NDArray[np.float64]) -> int:
        """Move the oldest records into `out` (n, width), a row a tick; returns how many."""
        turned = len(self._rings) > 1  # asked before it is emptied: a loop that has ended adds nothing
        count = int(take(self._rings[0], out))
        if count == 0 and turned:
            self._next()
            count = int(take(self._rings[0], out))
        return count

    def feeds(self) -> Iterator[Feed]:
        """Each ring once the one before has turned and was emptied; the last turns when no record comes any more."""
        yield Feed(self._rings[0], self._turns, self.wake_fd)
        while len(self._rings) > 1:
            self._next()
            yield Feed(self._rings[0], self._turns, self.wake_fd)

    def close(self) -> None:
        """Release the eventfd, once its reader has gone."""
        if self.wake_fd >= 0:
            os.close(self.wake_fd)
            self.wake_fd = -1

    def _next(self) -> None:
        self._dropped += int(self._rings[0].drops[0])
        del self._rings[0]
