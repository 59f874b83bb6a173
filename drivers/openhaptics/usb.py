"""What is attached and whether it may be opened, seen without the maker's library."""

from __future__ import annotations

from typing import Final

from softfinger.drivers.system import discovery, rules
from softfinger.drivers.system.discovery import Attached

VENDOR: Final = 0x2988
"""SensAble's, whose devices 3D Systems has taken over. A Touch on USB is a serial port; one with an Ethernet plug or on
FireWire is not seen."""


def attached() -> list[Attached]:
    """Every port or USB device of the vendor."""
    return [device for device in discovery.attached() if device.vendor == VENDOR]


def how_to_permit(device: Attached) -> str:
    """The message for a device that this user may not write to."""
    return f"{device} may not be opened by this user: {rules.how_to_permit(VENDOR, device.product)}"
