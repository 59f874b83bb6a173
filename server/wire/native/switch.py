"""Force switch in memory that is shared with the publisher process."""

from __future__ import annotations

import os
from typing import Final

from softfinger.server.loop.force_switch import make_switch
from softfinger.server.loop.switch_fields import STOPS_HANDLED, STOPS_RECEIVED
from softfinger.server.socket_process.brake import takes_force_off
from softfinger.server.wire.native.memory import PAGE_BYTES, map_file


class SharedSwitch:
    """Force switch in shared memory.

    words  (n,) int64
    file   file of the memory
    """

    def __init__(self) -> None:
        self.file: Final = os.memfd_create("softfinger-switch")
        try:
            os.ftruncate(self.file, PAGE_BYTES)
            self.words: Final = make_switch(map_file(self.file, PAGE_BYTES))
        except BaseException:
            os.close(self.file)
            raise

    def count_handled(self, body: bytes) -> None:
        """Count a client's request that was handled or declined, if it turns the force off."""
        if takes_force_off(body):
            self.words[STOPS_HANDLED] += 1

    def restart(self) -> None:
        """Reset the count, because a publisher that has exited may not have passed on all requests."""
        self.words[STOPS_HANDLED] = self.words[STOPS_RECEIVED]

    def close(self) -> None:
        """Close the file; the memory remains valid."""
        os.close(self.file)
