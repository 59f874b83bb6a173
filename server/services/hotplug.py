"""Detection of devices that are attached or detached while the daemon runs.

A separate thread lists the system's tables once per second. It opens no device and does not affect the servo.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import find_claim
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 1.0


class Hotplug:
    """Detector of changes of the attached devices, starting when it is created; `root` contains sys and dev."""

    def __init__(self, root: Path = discovery.ROOT) -> None:
        self._root = root
        self._known: dict[str, SystemDevice] = {}
        self.present = [device for _, device in self.changes()]
        """Devices attached when the object was created."""

    def changes(self) -> list[tuple[str, SystemDevice]]:
        """Return the changes since the last call: `detached` or `attached`, and the device."""
        names = discovery.list_names(self._root)
        detached = [("detached", self._known.pop(name)) for name in sorted(self._known.keys() - names)]
        attached = []
        for name in sorted(names - self._known.keys()):
            device = discovery.read_device(name, self._root)
            # A device listed before its ids can be read is examined again next time; so is a hub, which is never
            # described.
            if device is not None:
                self._known[name] = device
                attached.append(("attached", device))
        return [*detached, *attached]


def make_event_fields(device: SystemDevice) -> dict[str, Any]:
    """Return the keys of an event that identify the device."""
    claim = find_claim(device)
    return {
        "device": device.name,
        "bus": device.bus,
        "ids": device.ids,
        "serial": device.serial,
        "node": device.node,
        "driver": claim.driver if claim else "",
    }


class HotplugWatch(Worker):
    """Service that publishes by `event` all changes since `hotplug` was created, even if it is started later."""

    def __init__(self, hotplug: Hotplug, event: Callable[..., Any]) -> None:
        super().__init__("hotplug")
        self._hotplug, self._event = hotplug, event

    def work(self) -> None:
        for device in self._hotplug.present:
            self._event("device", "present", **make_event_fields(device))
        while not self.closing.wait(PERIOD_S):
            for action, device in self._hotplug.changes():
                log.info("%s: %s", action, device)
                self._event("device", action, **make_event_fields(device))

    def handle_failure(self, error: Exception) -> None:
        """Publish an event; the run continues, because rendering does not depend on this service."""
        self._event("fault", "hotplug", message=str(error))
