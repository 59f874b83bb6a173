"""Attached devices and their permissions, from USB and without the maker's library."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from softfinger.drivers.system import discovery, rules
from softfinger.drivers.system.discovery import SystemDevice

VENDOR: Final = 0x1451
PRODUCTS: Final = {0x0402: "omega.x haptic device", 0x0301: "omega.x", 0x040C: "lambda"}
"""Names of known product numbers; every device of the vendor is listed."""

NODES: Final = Path("/dev/bus/usb")


def list_attached() -> list[SystemDevice]:
    """Return every device of the vendor; none without USB, or without libusb."""
    devices: list[SystemDevice] = []
    for device in discovery.find_usb(idVendor=VENDOR):
        name = PRODUCTS.get(device.idProduct, "device of Force Dimension")
        node = NODES / f"{device.bus:03d}" / f"{device.address:03d}"
        devices.append(SystemDevice("usb", VENDOR, device.idProduct, name, "", str(node)))
    return devices


def refusal(device: SystemDevice) -> str:
    """Return the message for a device that this user may not write to; "" if it may, or if there is no node."""
    if not os.path.exists(device.node) or discovery.is_permitted(device.node):
        return ""
    return f"{device} may not be opened by this user: {rules.how_to_permit(VENDOR, 0)}"
