"""What a servo runs, and the step from one loop to the next."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

from softfinger.drivers.base import Device
from softfinger.server.loop.servo import Shared
from softfinger.server.loop.tick import Tuning


class Loop(NamedTuple):
    """What a servo runs: an open device for each finger, the tuning that the loop is compiled for, and the memory of
    both."""

    devices: tuple[Device, ...]
    tuning: Tuning
    shared: Shared
    arguments: tuple[Any, ...]


class Handover:
    """From one loop to the next, between the servo's thread and the one that replaces.

    keeps  the devices stay as they are, armed and at zero; else those of before are stopped, and the next ones armed
    """

    def __init__(self, keeps: bool) -> None:
        self.keeps = keeps
        self.left, self.ready, self.begun = threading.Event(), threading.Event(), threading.Event()
        self.loop: Loop | None = None
        self.error: BaseException | None = None
        self.first = 0
