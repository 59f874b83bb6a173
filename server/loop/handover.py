"""Loop that a servo runs, and the handover from one loop to the next; used by `servo_thread.py`."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

from softfinger.drivers.base import Device
from softfinger.server.loop.servo import SharedMemory
from softfinger.server.loop.tick import Tuning


class Loop(NamedTuple):
    """Loop of a servo: an open device for each finger, the tuning it is compiled for, and its memory."""

    devices: tuple[Device, ...]
    tuning: Tuning
    shared: SharedMemory
    arguments: tuple[Any, ...]


class Handover:
    """Synchronization between the servo thread and the thread that replaces its loop.

    keeps_devices  the devices do not change and remain armed at zero; otherwise the old ones are stopped and the
                   new ones armed
    loop_ended     the old loop has returned
    loop_ready     the replacing thread has set `loop` or `error`
    loop_started   the new loop starts, with tick `first`
    """

    def __init__(self, keeps_devices: bool) -> None:
        self.keeps_devices = keeps_devices
        self.loop_ended, self.loop_ready, self.loop_started = threading.Event(), threading.Event(), threading.Event()
        self.loop: Loop | None = None
        self.error: BaseException | None = None
        self.first = 0
