"""Rings of the successive loops of a servo, in order, for the single reader of its records."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.server.loop.shared.ring import Feed, Ring, take


class Rings:
    """Current ring, followed by the ring of the next loop if that uses another one.

    `add` and `end` are called by the servo thread, everything else by the reader, in one thread. The reader calls
    `wait`, then `take` until it returns 0. A reader without Python uses `feeds`.
    """

    def __init__(self) -> None:
        self.wake_fd = os.eventfd(0)
        """Eventfd, written after each record and after each change of rings."""
        self._completed_rings: Final = np.zeros(8, np.int64)
        self._rings: Final = list[Ring]()
        self._dropped = 0

    @property
    def newest(self) -> Ring | None:
        """Ring of the loop that runs or ran last."""
        return self._rings[-1] if self._rings else None

    @property
    def drops(self) -> int:
        """Records dropped because a ring was full."""
        return self._dropped + int(self._rings[0].drops[0])

    def add(self, ring: Ring) -> None:
        """Append the ring of a new loop, unless the loop reuses the previous ring."""
        if ring is self.newest:
            return
        self._rings.append(ring)
        if len(self._rings) > 1:
            self._completed_rings[0] += 1

    def end(self) -> None:
        """Mark the last ring as complete and wake the reader."""
        self._completed_rings[0] += 1
        os.eventfd_write(self.wake_fd, 1)

    def wait(self) -> None:
        """Sleep until a record is available or the last ring is complete."""
        wait_for_eventfd(self.wake_fd)

    def take(self, out: NDArray[np.float64]) -> int:
        """Move the oldest records into `out` (n, width), a row per tick; returns the number of rows."""
        is_complete = len(self._rings) > 1  # read before the ring is emptied: a finished loop adds no record
        count = int(take(self._rings[0], out))
        if count == 0 and is_complete:
            self._drop_first()
            count = int(take(self._rings[0], out))
        return count

    def feeds(self) -> Iterator[Feed]:
        """Yield each ring once the previous one is complete and empty; the last one completes when the servo ends."""
        yield Feed(self._rings[0], self._completed_rings, self.wake_fd)
        while len(self._rings) > 1:
            self._drop_first()
            yield Feed(self._rings[0], self._completed_rings, self.wake_fd)

    def close(self) -> None:
        """Release the eventfd; call it after the reader has stopped."""
        if self.wake_fd >= 0:
            os.close(self.wake_fd)
            self.wake_fd = -1

    def _drop_first(self) -> None:
        self._dropped += int(self._rings[0].drops[0])
        del self._rings[0]


def wait_for_eventfd(fd: int) -> None:
    """Sleep until the counter of an eventfd is above zero, and reset it.

    Retries after EINTR: the kernel may deliver a signal to any thread, and Python does not retry this call.
    """
    while True:
        try:
            os.eventfd_read(fd)
        except InterruptedError:
            continue
        return
