"""Force switch in memory that is shared with the publisher process."""

from __future__ import annotations

import os
from typing import Final

import msgspec

from softfinger.server.loop.force_switch import make_switch
from softfinger.server.loop.switch_fields import STOPS_HANDLED, STOPS_RECEIVED
from softfinger.server.socket_process.brake import takes_force_off
from softfinger.server.wire.native.memory import PAGE_BYTES, map_file

DISARM: Final = msgspec.msgpack.encode({"command_id": "", "method": "disarm"})


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

    def lost_requests(self) -> list[bytes]:
        """Return a `disarm` for the requests that a process has received, but did not pass on before it exited."""
        lost = self.words[STOPS_HANDLED] != self.words[STOPS_RECEIVED]
        self.words[STOPS_HANDLED] = self.words[STOPS_RECEIVED] - lost
        return [DISARM] if lost else []

    def close(self) -> None:
        """Close the file; the memory remains valid."""
        os.close(self.file)
