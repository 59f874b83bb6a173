"""USB device in the kernel: descriptors in configfs, plugged in by binding it to a controller."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

GADGETS = Path("/sys/kernel/config/usb_gadget")
CONTROLLERS = Path("/sys/class/udc")
DEVICES = Path("/sys/bus/usb/devices")
PLUG_S = 10.0
"""Maximum time in which the emulated kernel finds a device."""


def settle() -> None:
    """Wait until udev has set a device's mode and notified programs."""
    subprocess.run(["udevadm", "settle"], check=True)


class Gadget:
    """A device with one configuration on controller `number`, without functions yet, not plugged in."""

    def __init__(self, number: int, vendor: int, product: int, maker: str, name: str, serial: str) -> None:
        self.ids = (vendor, product)
        self.controller = sorted(os.listdir(CONTROLLERS))[number]
        self.folder = GADGETS / f"softfinger{number}"
        if self.folder.exists():  # from an earlier process
            self._clear()
        self.folder.mkdir()
        self.write("idVendor", f"{vendor:#06x}")
        self.write("idProduct", f"{product:#06x}")
        self.write("bcdUSB", "0x0200")
        self.write("bcdDevice", "0x0400")
        texts = self.folder / "strings/0x409"
        texts.mkdir()
        for key, text in (("manufacturer", maker), ("product", name), ("serialnumber", serial)):
            (texts / key).write_text(text)
        (self.folder / "configs/c.1").mkdir()

    def _clear(self) -> None:
        if self.plugged:
            self.write("UDC", "\n")
        configuration = self.folder / "configs/c.1"
        for link in [path for path in configuration.iterdir() if path.is_symlink()]:
            link.unlink()
        functions = list((self.folder / "functions").iterdir())
        for path in (configuration, *functions, self.folder / "strings/0x409", self.folder):
            path.rmdir()

    def write(self, key: str, text: str) -> None:
        (self.folder / key).write_text(text)

    def function(self, name: str, **attributes: str | bytes) -> None:
        """Add a function of configfs, named by its type and an instance: ffs.falcon."""
        folder = self.folder / "functions" / name
        folder.mkdir()
        for key, value in attributes.items():
            (folder / key).write_bytes(value if isinstance(value, bytes) else value.encode())
        (self.folder / "configs/c.1" / name).symlink_to(folder)

    @property
    def plugged(self) -> bool:
        return bool((self.folder / "UDC").read_text().strip())

    def plug(self) -> None:
        """Plug it in, and wait until the host has its node."""
        self.write("UDC", self.controller)
        until = time.monotonic() + PLUG_S
        while self.node is None:
            if time.monotonic() > until:
                raise TimeoutError(f"the kernel does not find the device on {self.controller}")
            time.sleep(0.01)
        settle()

    def unplug(self) -> None:
        """Unplug it, and wait until the host has removed its node; may be called repeatedly."""
        if self.plugged:
            self.write("UDC", "\n")
        while self.node is not None:
            time.sleep(0.01)
        settle()

    @property
    def node(self) -> str | None:
        """Node of the device in /dev/bus/usb, or None if it is not configured."""
        for path in DEVICES.iterdir():
            try:
                ids = tuple(int((path / key).read_text(), 16) for key in ("idVendor", "idProduct"))
                if ids == self.ids and (path / "bConfigurationValue").read_text().strip():
                    bus, number = (int((path / key).read_text()) for key in ("busnum", "devnum"))
                    return f"/dev/bus/usb/{bus:03d}/{number:03d}"
            except (OSError, ValueError):  # an interface, or a device that is being added or removed
                continue
        return None
