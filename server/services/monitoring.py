"""Monitoring of the devices' warnings, memory in swap, attached and detached devices, and files of sockets.

These affect rendering but do not end it: they go to the log and to subscribers. The thread for attached and detached
devices lists the system's tables once per second; it opens no device.
"""

from __future__ import annotations

import logging
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import HapticError
from softfinger.drivers.base import Device
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import find_claim
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

DEVICE_PERIOD_S: Final = 0.5
SWAP_PERIOD_S: Final = 1.0
HOTPLUG_PERIOD_S: Final = 1.0
SOCKET_FILE_PERIOD_S: Final = 0.5
DEVICE_WARNING: Final = "device_warning"
SWAPPED: Final = "swapped"
STATUS: Final = Path("/proc/self/status")
SWAP_REMEDY: Final = (
    "ticks that need this memory wait for the disk: end programs that fill the memory, or let the daemon lock its "
    "memory (see `softfinger doctor`)"
)


class PeriodicCheck(Worker):
    """Service that calls `check` periodically; a failure is an event, and the run continues.

    Missing resources of the system, such as file descriptors, are reported once, and `check` is called again later.

    fault    name of the fault events, and of the thread
    subject  what is no longer reported after a failure
    event    publishes an event
    """

    def __init__(self, fault: str, subject: str, period_s: float, event: Callable[..., Any]) -> None:
        super().__init__(fault)
        self._subject, self._period_s, self._event = subject, period_s, event

    @abstractmethod
    def check(self) -> None: ...

    def work(self) -> None:
        reported = ""
        while True:
            try:
                self.check()
                reported = ""
            except (OSError, HapticError) as error:
                if str(error) != reported:
                    self.warn(f"{self.name}: {error}; checked again every {self._period_s:g} s")
                reported = str(error)
            if self.closing.wait(self._period_s):
                return

    def warn(self, message: str) -> None:
        log.warning("%s", message)
        self._event("fault", self.name, message=message)

    def handle_failure(self, error: Exception) -> None:
        self._event("fault", self.name, message=f"{self._subject} no longer reported: {error}")


class DeviceWarningMonitor(PeriodicCheck):
    """Service that polls the devices for warnings, and reports each once, when it starts or changes."""

    def __init__(self, devices: Callable[[], Sequence[Device]], event: Callable[..., Any]) -> None:
        super().__init__(DEVICE_WARNING, "warnings of devices are", DEVICE_PERIOD_S, event)
        self._devices = devices
        self._reported: set[tuple[str, str]] = set()

    def check(self) -> None:
        now = {(device.info.name, device.warning()) for device in self._devices()}
        for name, warning in sorted(now - self._reported):
            if warning:
                self.warn(f"{name}: {warning}")
        self._reported = now


class SwapMonitor(PeriodicCheck):
    """Service that checks for memory of the daemon in swap, and reports it once until all of it is back.

    status  of the process, in the format of proc_pid_status(5)
    """

    def __init__(self, event: Callable[..., Any], status: Path = STATUS) -> None:
        super().__init__(SWAPPED, "memory in swap is", SWAP_PERIOD_S, event)
        self._status = status
        self._reported = False

    def check(self) -> None:
        kilobytes = parse_swapped_kb(self._status.read_text())
        if kilobytes and not self._reported:
            self.warn(f"{kilobytes} kB of the daemon are in swap: {SWAP_REMEDY}")
        self._reported = kilobytes > 0


def parse_swapped_kb(status: str) -> int:
    """Return the memory of a process in swap, kB; 0 if the system does not report it."""
    match = re.search(r"^VmSwap:\s+(\d+) kB$", status, re.MULTILINE)
    return int(match[1]) if match else 0


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


class HotplugMonitor(PeriodicCheck):
    """Service that publishes the devices attached when it was created, then each that is attached or detached.

    root  contains sys and dev
    """

    def __init__(self, event: Callable[..., Any], root: Path = discovery.ROOT) -> None:
        super().__init__("hotplug", "attached and detached devices are", HOTPLUG_PERIOD_S, event)
        self._root = root
        self._known: dict[str, SystemDevice] = {}
        self._present = [device for _, device in self.changes()]

    def changes(self) -> list[tuple[str, SystemDevice]]:
        """Return the changes since the last call: `detached` or `attached`, and the device."""
        names = discovery.list_names(self._root)
        detached = [("detached", self._known.pop(name)) for name in sorted(self._known.keys() - names)]
        attached = []
        for name in sorted(names - self._known.keys()):
            device = discovery.read_device(name, self._root)
            # Not described: a hub, or a device whose ids cannot be read yet. It is examined again next time.
            if device is not None:
                self._known[name] = device
                attached.append(("attached", device))
        return [*detached, *attached]

    def check(self) -> None:
        for action, device in self.changes():
            log.info("%s: %s", action, device)
            self._event("device", action, **make_event_fields(device))

    def work(self) -> None:
        for device in self._present:
            self._event("device", "present", **make_event_fields(device))
        super().work()


class SocketFileMonitor(PeriodicCheck):
    """Service that binds the ipc endpoints again if their files are removed, as systemd does at the end of a session.

    Without the file, no new client can connect to send `disarm`.

    rebind  binds sockets without a file again; yields their endpoints
    """

    def __init__(self, rebind: Callable[[], Iterable[str]], event: Callable[..., Any]) -> None:
        super().__init__("publisher", "endpoints whose socket file was removed are", SOCKET_FILE_PERIOD_S, event)
        self._rebind = rebind

    def check(self) -> None:
        for endpoint in self._rebind():
            self.warn(f"{endpoint}: the socket file was removed or replaced, and the endpoint was bound again")
