"""Attached devices and their permissions, without the maker's library."""

from __future__ import annotations

from softfinger.drivers.system import discovery, rules
from softfinger.drivers.system.claims import TOUCHES
from softfinger.drivers.system.discovery import SystemDevice


def list_attached() -> list[SystemDevice]:
    """Return every port, HID node or USB device of 3D Systems; devices with Ethernet or FireWire are not listed."""
    return [
        device
        for device in discovery.list_attached()
        if any(device.vendor == vendor and product in (None, device.product) for _, vendor, product in TOUCHES)
    ]


def how_to_permit(device: SystemDevice) -> str:
    return f"{device} may not be opened by this user: {rules.how_to_permit(device.vendor, device.product)}"
