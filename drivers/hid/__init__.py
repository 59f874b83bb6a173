"""Devices on USB HID: WoodenHaptics and its relatives, and any device whose reports its rig describes.

What a rig may say is in `options`, the bytes in `reports`, the arm in `chain`, the system's node in `node`, the
exchange of a tick in `exchange`; `device` puts them together.
"""

from softfinger.drivers.hid.device import HidDevice, open_device
from softfinger.drivers.hid.options import Options

__all__ = ["HidDevice", "Options", "open_device"]
