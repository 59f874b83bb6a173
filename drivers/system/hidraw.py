"""Exclusive opening of a HID device's node, with a check that it is the intended device."""

from __future__ import annotations

import fcntl
import importlib
import os
import stat
import struct
from typing import Any, Final

from softfinger.config.errors import DeviceError
from softfinger.drivers.system.nodes import open_locked
from softfinger.drivers.system.rules import explain_permission

_GET_INFO: Final = 0x80084803  # an ioctl request of <linux/hidraw.h>


def open_path(path: str, vendor: int, product: int) -> int:
    """Open the node of a device with these ids, non-blocking and locked, and return its file descriptor.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is another device.
    """
    fd = open_locked(path, explain_permission(vendor, product))
    try:
        _check_device(fd, path, vendor, product)
    except BaseException:
        os.close(fd)
        raise
    return fd


def import_hidapi(backend: str) -> Any:
    """Import module `hidraw` or `hid` of hidapi; raises DeviceError if it, or a library that it needs, is missing.

    Call it only when needed: the import opens the system's device list.
    """
    try:
        return importlib.import_module(backend)
    except ImportError as error:
        raise DeviceError(
            f"hidapi cannot be loaded ({error}): `pip install --force-reinstall hidapi`, and "
            "`apt install libusb-1.0-0 libudev1`"
        ) from error


def read_ids(vendor: int, product: int) -> str:
    return f"{vendor:04x}:{product:04x}"


def _check_device(fd: int, path: str, wanted_vendor: int, wanted_product: int) -> None:
    info = bytearray(8)
    try:
        if not stat.S_ISCHR(os.fstat(fd).st_mode):
            raise DeviceError(f"{path} is not a device node: use a /dev/hidrawN, or remove `path`")
        fcntl.ioctl(fd, _GET_INFO, info)
    except OSError as error:
        raise DeviceError(f"{path} is not a hidraw node: {error.strerror}: use a /dev/hidrawN") from error
    _, vendor, product = struct.unpack("<IHH", info)
    if (vendor, product) != (wanted_vendor, wanted_product):
        raise DeviceError(
            f"{path} is the device {read_ids(vendor, product)}, but the rig is for "
            f"{read_ids(wanted_vendor, wanted_product)}: set path to the right node, or remove it"
        )
