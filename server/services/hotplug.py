"""Noticing what is plugged in and pulled out while the daemon runs.

The system's tables are listed once a second, in a thread of its own; nothing is opened, and the servo does not know.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import claim_on
from softfinger.drivers.system.discovery import Attached
from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 1.0


class Hotplug:
    """Compares what is attached with what was, from the time it is made. `root` holds sys and dev."""

    def __init__(self, root: Path = discovery.ROOT) -> None:
        self._root = root
        self._known: dict[str, Attached] = {}
        self.present = [device for _, device in self.changes()]
        """What was there when this was made."""

    def changes(self) -> list[tuple[str, Attached]]:
        """What happened since the last call: `detached` or `attached`, and the device."""
        names = discovery.names(self._root)
        gone = [("detached", self._known.pop(name)) for name in sorted(self._known.keys() - names)]
        came = []
        for name in sorted(names - self._known.keys()):
            device = discovery.described(name, self._root)
            # A device that is listed before its ids can be read is looked at again; a hub too, for it says nothing.
            if device is not None:
                self._known[name] = device
                came.append(("attached", device))
        return [*gone, *came]


def watch(hotplug: Hotplug, event: Callable[..., None], closing: threading.Event) -> None:
    """Report what was there, then every change, as an event of kind `device` each, until `closing` is set."""
    for device in hotplug.present:
        event("device", "present", **described(device))
    while not closing.wait(PERIOD_S):
        for what, device in hotplug.changes():
            log.info("%s: %s", what, device)
            event("device", what, **described(device))


def described(device: Attached) -> dict[str, Any]:
    """The keys of an event that tell which device it is."""
    claim = claim_on(device)
    return {
        "device": device.name,
        "bus": device.bus,
        "ids": device.ids,
        "serial": device.serial,
        "node": device.node,
        "driver": claim.driver if claim else "",
    }


class HotplugWatch(Worker):
    """Publishes by `event` what is plugged in and pulled out since `hotplug` was made, however late this is started."""

    def __init__(self, hotplug: Hotplug, event: Callable[..., Any]) -> None:
        super().__init__("hotplug")
        self._attached, self._event = hotplug, event

    def work(self) -> None:
        watch(self._attached, self._event, self.closing)

    def failed(self, error: Exception) -> None:
        """What is rendered needs none of it: the run goes on."""
        self._event("fault", "hotplug", message=str(error))
