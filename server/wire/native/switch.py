"""The switch of the force as memory that the publisher's process shares."""

from __future__ import annotations

import os
from typing import Final

from softfinger.server.loop.force_switch import make_switch
from softfinger.server.loop.switch_words import ASKED, OBEYED
from softfinger.server.publishing.brake import takes_force_off
from softfinger.server.wire.native.memory import PAGE_BYTES, mapped


class SharedSwitch:
    """A switch whose memory the publisher's process shares.

    words  (n,) int64
    file   of them
    """

    def __init__(self) -> None:
        self.file: Final = os.memfd_create("softfinger-switch")
        try:
            os.ftruncate(self.file, PAGE_BYTES)
            self.words: Final = make_switch(mapped(self.file, PAGE_BYTES))
        except BaseException:
            os.close(self.file)
            raise

    def obeyed(self, body: bytes) -> None:
        """Note that a request of a client has been done, or declined."""
        if takes_force_off(body):
            self.words[OBEYED] += 1

    def restart(self) -> None:
        """Forget requests that a publisher which has ended did not hand on."""
        self.words[OBEYED] = self.words[ASKED]

    def close(self) -> None:
        """Close the file; the words stay."""
        os.close(self.file)
