"""Force switch in memory that is shared with the process of commands."""

from __future__ import annotations

import os
from functools import partial
from typing import Final

import msgspec

from softfinger.drivers.closeable import undo_on_error
from softfinger.server.loop.force_switch import UNREACHABLE_MAX_NS, make_switch
from softfinger.server.loop.switch_fields import STOPS_HANDLED, STOPS_RECEIVED, UNREACHABLE_NS
from softfinger.server.socket_process.force_off import takes_force_off
from softfinger.server.wire.native.memory import PAGE_BYTES, map_file

DISARM: Final = msgspec.msgpack.encode({"command_id": "", "method": "disarm"})


class SharedSwitch:
    """Force switch in shared memory.

    words  (n,) int64
    file   file of the memory
    """

    def __init__(self) -> None:
        self.file: Final = os.memfd_create("softfinger-switch")
        with undo_on_error(partial(os.close, self.file)):
            os.ftruncate(self.file, PAGE_BYTES)
            self.words: Final = make_switch(map_file(self.file, PAGE_BYTES))

    def count_handled(self, body: bytes) -> None:
        """Count a client's request that was handled or declined, if it turns the force off."""
        if takes_force_off(body):
            self.words[STOPS_HANDLED] += 1

    def require_process(self) -> None:
        """Allow no force until a process of commands reads requests, and while it does not."""
        self.words[UNREACHABLE_NS] = UNREACHABLE_MAX_NS + 1

    def replace_process(self) -> list[bytes]:
        """Turn the force off because the process of commands has exited, perhaps with requests to turn it off.

        Returns a `disarm`; until it is counted as handled, the force remains off.
        """
        self.words[STOPS_HANDLED] = self.words[STOPS_RECEIVED] - 1
        return [DISARM]

    def close(self) -> None:
        """Close the file; the memory remains valid."""
        os.close(self.file)
