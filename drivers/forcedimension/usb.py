"""Attached devices and their permissions, from USB and without the maker's library."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, NamedTuple

from softfinger.drivers.system import discovery, rules

VENDOR: Final = 0x1451
PRODUCTS: Final = {0x0402: "omega.x haptic device", 0x0301: "omega.x", 0x040C: "lambda"}
"""Names of known product numbers; every device of the vendor is listed."""

NODES: Final = Path("/dev/bus/usb")


class UsbDevice(NamedTuple):
    """Device on the bus: name, node, and True if this user may write to the node or there is none."""

    name: str
    node: Path
    permitted: bool

    def __str__(self) -> str:
        return f"{self.name} at {self.node}"


def list_attached() -> list[UsbDevice]:
    """Return every device of the vendor; none without USB, or without libusb."""
    devices: list[UsbDevice] = []
    for device in discovery.find_usb(idVendor=VENDOR):
        node = NODES / f"{device.bus:03d}" / f"{device.address:03d}"
        name = PRODUCTS.get(device.idProduct, "device of Force Dimension")
        permitted = not os.path.exists(node) or os.access(node, os.R_OK | os.W_OK, effective_ids=True)
        devices.append(UsbDevice(f"{name} ({VENDOR:04x}:{device.idProduct:04x})", node, permitted))
    return devices


def holders(device: UsbDevice) -> list[str]:
    """Return visible processes with the device's node open, as `name (pid)`, except this process."""
    processes: list[str] = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            is_open = any(os.path.samefile(link, device.node) for link in (process / "fd").iterdir())
            if is_open and process.name != str(os.getpid()):
                processes.append(f"{(process / 'comm').read_text().strip()} ({process.name})")
        except OSError:  # it has exited, belongs to another user, or there is no node
            continue
    return sorted(processes)


def how_to_permit(device: UsbDevice) -> str:
    """Return the message for a device that this user may not write to."""
    return f"{device} may not be opened by this user: {rules.how_to_permit(VENDOR, 0)}"
