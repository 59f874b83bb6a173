"""libusb for pyusb: the system's if the loader finds it, else that of libusb-package.

Every search for USB devices through pyusb uses this module, so that a process loads only one libusb, once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Final

from softfinger.config.errors import DeviceError

SONAME: Final = "libusb-1.0.so.0"
MISSING: Final = "libusb, which is needed for USB devices, is not installed or cannot be loaded"
REMEDY: Final = "pip install --force-reinstall libusb-package, or apt install libusb-1.0-0"


def load_backend() -> Any | None:
    """Return the backend of pyusb; None if no libusb can be loaded."""
    import usb.backend.libusb1

    # By name: pyusb's default search runs ldconfig, a compiler and a linker if it finds no library.
    finders: list[Callable[[str], str | None]] = [lambda _: SONAME]
    with contextlib.suppress(ImportError):  # a distribution with a system libusb may omit the package
        import libusb_package

        finders.append(libusb_package.find_library)
    libraries = (usb.backend.libusb1.get_backend(find_library=find) for find in finders)
    return next((library for library in libraries if library is not None), None)


def find_origin() -> str:
    """Return the name or path of the libusb that pyusb uses; empty if none can be loaded."""
    return str(library.lib._name) if (library := load_backend()) is not None else ""


def find(**ids: int) -> list[Any]:
    """Return pyusb's devices with these ids.

    Raises DeviceError if no libusb can be loaded, usb.core.USBError if the bus cannot be listed.
    """
    import usb.core

    usb_backend = load_backend()
    if usb_backend is None:
        raise DeviceError(f"{MISSING}: `{REMEDY}`")
    return list(usb.core.find(find_all=True, backend=usb_backend, **ids))
