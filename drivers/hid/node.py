"""Exclusive opening of hidraw nodes, with a comparison of their reports with a rig's."""

from __future__ import annotations

import fcntl
import os
import struct
from typing import Any, Final

from softfinger.config.errors import DeviceError
from softfinger.drivers.hid.descriptor import check_reports
from softfinger.drivers.hid.options import Options
from softfinger.drivers.hid.report_threads import HidApi
from softfinger.drivers.system.hidraw import hidapi, open_path

# Requests for ioctl, from <linux/hidraw.h>.
_GET_DESCRIPTOR_SIZE: Final = 0x80044801
_GET_DESCRIPTOR: Final = 0x90044802
_DESCRIPTOR_MAX: Final = 4096


def open_node(path: str, options: Options) -> int:
    """Open the device's node, non-blocking and locked, and return its file descriptor.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is another device, or has other reports
    than the rig.
    """
    fd = open_path(path, options.vendor_id, options.product_id)
    try:
        check_reports(_descriptor(fd, path), path, options.reports)
    except BaseException:
        os.close(fd)
        raise
    return fd


def open_hidapi(path: str) -> HidApi:
    """Open the node again, through hidapi's hidraw backend; raises DeviceError if that fails."""
    device: Any = hidapi("hidraw").device()
    try:
        device.open_path(os.fsencode(path))
    except OSError as error:
        raise DeviceError(f"{path} cannot be opened by hidapi: {device.error()}: set through to node") from error
    opened: HidApi = device
    return opened


def _descriptor(fd: int, path: str) -> bytes:
    try:
        size = bytearray(4)
        fcntl.ioctl(fd, _GET_DESCRIPTOR_SIZE, size)
        buffer = bytearray(size) + bytearray(_DESCRIPTOR_MAX)
        fcntl.ioctl(fd, _GET_DESCRIPTOR, buffer)
    except OSError as error:
        raise DeviceError(f"{path} does not return its report descriptor: {error.strerror}") from error
    return bytes(buffer[4 : 4 + struct.unpack("<i", size)[0]])
