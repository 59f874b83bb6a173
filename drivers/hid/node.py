"""The system's node of a HID device: found by its USB ids, opened for this process alone, its reports compared."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import struct
import sys
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission
from softfinger.drivers.hid.descriptor import Announced, announced
from softfinger.drivers.hid.options import Options

# ioctl requests of <linux/hidraw.h>.
_GET_DESCRIPTOR_SIZE: Final = 0x80044801
_GET_DESCRIPTOR: Final = 0x90044802
_GET_INFO: Final = 0x80084803
_DESCRIPTOR_MAX: Final = 4096


def open_node(options: Options) -> int:
    """File descriptor of the device's node, non-blocking, locked.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError when it is another device, or one whose
    reports are not those of the rig.
    """
    if not sys.platform.startswith("linux"):
        raise DeviceError(f"driver 'hid' exchanges reports through Linux's hidraw, and this is {sys.platform}")
    path = options.path or find(options)
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise _unopened(path, options, error) from error
    try:
        _lock(fd, path)
        _check_device(fd, path, options)
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
    wanted = _ids(options.vendor_id, options.product_id)
    matching = [path for path, serial in nodes.items() if options.serial is None or serial == options.serial]
    if len(matching) == 1:
        return matching[0]
    if matching:
        listed = ", ".join(f"{path} (serial '{nodes[path]}')" for path in sorted(matching))
        raise DeviceNotFound(f"{len(matching)} HID devices are {wanted}: name one with serial or path: {listed}")
    if nodes:
        serials = ", ".join(f"'{serial}'" for serial in sorted(nodes.values()))
        raise DeviceNotFound(f"no HID device {wanted} has the serial number '{options.serial}': attached are {serials}")
    others = sorted({_ids(one["vendor_id"], one["product_id"]) for one in attached})
    there = f"attached are {', '.join(others)}" if others else "no HID device is attached"
    raise DeviceNotFound(f"no HID device {wanted} is attached: plug it in and switch it on; {there}")


def _ids(vendor: int, product: int) -> str:
    return f"{vendor:04x}:{product:04x}"


def _unopened(path: str, options: Options, error: OSError) -> DeviceError:
    reason = error.strerror or str(error)
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceNotFound(f"{path} cannot be opened: {reason}: plug the device in, or leave `path` out")
    if error.errno in (errno.EACCES, errno.EPERM):
        rule = (
            f'KERNEL=="hidraw*", ATTRS{{idVendor}}=="{options.vendor_id:04x}", '
            f'ATTRS{{idProduct}}=="{options.product_id:04x}", TAG+="uaccess"'
        )
        return DevicePermission(
            f"{path} may not be opened by this user: {reason}: write {rule} to "
            "/etc/udev/rules.d/70-softfinger-hid.rules, run `udevadm control --reload`, and plug the device in again"
        )
    if error.errno == errno.EBUSY:
        return DeviceBusy(f"{path} is held by another program: close that one first")
    return DeviceError(f"{path} cannot be opened: {reason}")


def _lock(fd: int, path: str) -> None:
    # hidraw itself lets any number of programs write to one device; two that command forces must not.
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise DeviceBusy(f"{path} is held by {_holder(fd)}: end that one first") from error
    except OSError:
        pass  # a node on a file system without locks


def _holder(fd: int) -> str:
    inode = os.fstat(fd).st_ino
    try:
        for line in Path("/proc/locks").read_text().splitlines():
            part = line.split()
            if part[1] == "FLOCK" and int(part[-3].rsplit(":", 1)[1]) == inode:
                pid = int(part[-4])
                return f"process {pid} ({Path(f'/proc/{pid}/comm').read_text().strip()})"
    except (OSError, ValueError, IndexError):
        pass
    return "another process"


def _check_device(fd: int, path: str, options: Options) -> None:
    info = bytearray(8)
    try:
        if not stat.S_ISCHR(os.fstat(fd).st_mode):
            raise DeviceError(f"{path} is no device node: name a /dev/hidrawN, or leave `path` out")
        fcntl.ioctl(fd, _GET_INFO, info)
    except OSError as error:
        raise DeviceError(f"{path} is no hidraw node: {error.strerror}: name a /dev/hidrawN") from error
    _, vendor, product = struct.unpack("<IHH", info)
    if (vendor, product) != (options.vendor_id, options.product_id):
        raise DeviceError(
            f"{path} is the device {_ids(vendor, product)}, and the rig is for "
            f"{_ids(options.vendor_id, options.product_id)}: name the right node, or leave `path` out"
        )


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
