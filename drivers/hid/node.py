"""The system's node of a HID device: found by its USB ids, opened for this process alone, its reports compared."""

from __future__ import annotations

import fcntl
import os
import struct
import sys
from typing import Any, Final

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.drivers.hid.descriptor import Announced, announced
from softfinger.drivers.hid.options import Options
from softfinger.drivers.hidraw import ids, open_path

# ioctl requests of <linux/hidraw.h>.
_GET_DESCRIPTOR_SIZE: Final = 0x80044801
_GET_DESCRIPTOR: Final = 0x90044802
_DESCRIPTOR_MAX: Final = 4096


def open_node(options: Options) -> int:
    """File descriptor of the device's node, non-blocking, locked.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError when it is another device, or one whose
    reports are not those of the rig.
    """
    if not sys.platform.startswith("linux"):
        raise DeviceError(f"driver 'hid' exchanges reports through Linux's hidraw, and this is {sys.platform}")
    path = options.path or find(options)
    fd = open_path(path, options.vendor_id, options.product_id)
    try:
        _check_reports(fd, path, options)
    except BaseException:
        os.close(fd)
        raise
    return fd


def find(options: Options) -> str:
    """Path of the node of the one device with the rig's ids; DeviceNotFound when there is none or more than one."""
    import hidraw  # here, because it opens the system's device list when it is imported

    attached: list[dict[str, Any]] = hidraw.enumerate()
    nodes = {
        os.fsdecode(one["path"]): one["serial_number"] or ""
        for one in attached
        if (one["vendor_id"], one["product_id"]) == (options.vendor_id, options.product_id)
    }
    wanted = ids(options.vendor_id, options.product_id)
    matching = [path for path, serial in nodes.items() if options.serial is None or serial == options.serial]
    if len(matching) == 1:
        return matching[0]
    if matching:
        listed = ", ".join(f"{path} (serial '{nodes[path]}')" for path in sorted(matching))
        raise DeviceNotFound(f"{len(matching)} HID devices are {wanted}: name one with serial or path: {listed}")
    if nodes:
        serials = ", ".join(f"'{serial}'" for serial in sorted(nodes.values()))
        raise DeviceNotFound(f"no HID device {wanted} has the serial number '{options.serial}': attached are {serials}")
    others = sorted({ids(one["vendor_id"], one["product_id"]) for one in attached})
    there = f"attached are {', '.join(others)}" if others else "no HID device is attached"
    raise DeviceNotFound(f"no HID device {wanted} is attached: plug it in and switch it on; {there}")


def _check_reports(fd: int, path: str, options: Options) -> None:
    """DeviceError when the device announces other reports than the rig describes; the message shows both."""
    try:
        size = bytearray(4)
        fcntl.ioctl(fd, _GET_DESCRIPTOR_SIZE, size)
        buffer = bytearray(size) + bytearray(_DESCRIPTOR_MAX)
        fcntl.ioctl(fd, _GET_DESCRIPTOR, buffer)
    except OSError as error:
        raise DeviceError(f"{path} does not give its report descriptor: {error.strerror}") from error
    descriptor = bytes(buffer[4 : 4 + struct.unpack("<i", size)[0]])
    try:
        theirs = announced(descriptor)
    except ValueError as error:
        raise DeviceError(f"{path}: its report descriptor is damaged: {error}") from error
    reports = options.reports
    ours = Announced({reports.input.id: reports.input.bytes}, {reports.output.id: reports.output.bytes})
    for mine, has in ((ours.input, theirs.input), (ours.output, theirs.output)):
        if not mine.items() <= has.items():
            raise DeviceError(
                f"{path} has other reports than the rig: the device announces {theirs}; the rig describes {ours}: "
                f"correct [device.reports] (descriptor {descriptor.hex()})"
            )
