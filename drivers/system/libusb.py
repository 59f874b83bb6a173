"""libusb for pyusb: the one that the loader finds, which is the system's, else the one that libusb-package brings.

Every search for USB devices through pyusb uses this module, so that a process loads one libusb only. pyusb loads it
once and keeps it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from softfinger.config.errors import DeviceError

SONAME: Final = "libusb-1.0.so.0"
MISSING: Final = "libusb is not installed or cannot be loaded, and USB devices are reached through it"
REMEDY: Final = "pip install --force-reinstall libusb-package, or apt install libusb-1.0-0"


def backend() -> Any | None:
    """pyusb's backend; None where neither libusb can be loaded."""
    import usb.backend.libusb1

    for find in (_by_the_loader, _of_the_package()):
        if find is not None and (found := usb.backend.libusb1.get_backend(find_library=find)) is not None:
            return found
    return None


def origin() -> str:
    """Name or path of the libusb that pyusb uses; empty where none can be loaded."""
    return str(found.lib._name) if (found := backend()) is not None else ""


def find(**ids: int) -> list[Any]:
    """pyusb's devices of these ids.

    Raises DeviceError where no libusb can be loaded, usb.core.USBError where the bus cannot be listed.
    """
    import usb.core

    through = backend()
    if through is None:
        raise DeviceError(f"{MISSING}: `{REMEDY}`")
    return list(usb.core.find(find_all=True, backend=through, **ids))


def _by_the_loader(_: str) -> str:
    """Its soname. pyusb's own search runs ldconfig, a compiler and a linker where this does not find one."""
    return SONAME


def _of_the_package() -> Callable[[str], str | None] | None:
    try:
        import libusb_package
    except ImportError:  # a distribution that has libusb itself may leave it out
        return None
    return libusb_package.find_library
