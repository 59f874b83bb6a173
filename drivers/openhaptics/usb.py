"""Attached devices and their permissions, without the maker's library."""

from __future__ import annotations

from typing import Final

from softfinger.drivers.system import discovery, rules
from softfinger.drivers.system.discovery import Attached

VENDOR: Final = 0x2988
"""Vendor id of SensAble, now 3D Systems.

A Touch on USB is a serial port; devices with Ethernet or FireWire are not listed.
"""


def attached() -> list[Attached]:
    """Return every port or USB device of the vendor."""
    return [device for device in discovery.attached() if device.vendor == VENDOR]


def how_to_permit(device: Attached) -> str:
    """Return the message for a device that this user may not write to."""
    return f"{device} may not be opened by this user: {rules.how_to_permit(VENDOR, device.product)}"
