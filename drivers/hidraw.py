"""The node of a HID device, opened for this process alone, and known to be the device that was meant."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import struct
from typing import Final

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission
from softfinger.drivers import discovery

_GET_INFO: Final = 0x80084803  # an ioctl request of <linux/hidraw.h>


def open_path(path: str, vendor: int, product: int) -> int:
    """File descriptor of a node of a device with these ids, non-blocking, locked.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError when it is another device.
    """
    fd = open_locked(path, discovery.hid_rule(vendor, product))
    try:
        _check_device(fd, path, vendor, product)
    except BaseException:
        os.close(fd)
        raise
    return fd


def open_locked(path: str, rule: str) -> int:
    """File descriptor of any node of a HID device, non-blocking, locked; `rule` of udev lets the user open it.

    Raises DeviceNotFound, DevicePermission, DeviceBusy or DeviceError.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise _unopened(path, rule, error) from error
    try:
        _lock(fd, path)
    except BaseException:
        os.close(fd)
        raise
    return fd


def ids(vendor: int, product: int) -> str:
    return f"{vendor:04x}:{product:04x}"


def _unopened(path: str, rule: str, error: OSError) -> DeviceError:
    reason = error.strerror or str(error)
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceNotFound(f"{path} cannot be opened: {reason}: plug the device in, or leave `path` out")
    if error.errno in (errno.EACCES, errno.EPERM):
        return DevicePermission(
            f"{path} may not be opened by this user: {reason}: write "
            f"{rule} to {discovery.HID_RULE_FILE}, run `udevadm control --reload`, and plug the device in again"
        )
    if error.errno == errno.EBUSY:
        return DeviceBusy(f"{path} is held by another program: close that one first")
    return DeviceError(f"{path} cannot be opened: {reason}")


def _lock(fd: int, path: str) -> None:
    # hidraw itself lets any number of programs write to one device; two that command forces must not.
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        who = discovery.holder(path) or "another process"
        raise DeviceBusy(f"{path} is held by {who}: end that one first") from error
    except OSError:
        pass  # a node on a file system without locks


def _check_device(fd: int, path: str, wanted_vendor: int, wanted_product: int) -> None:
    info = bytearray(8)
    try:
        if not stat.S_ISCHR(os.fstat(fd).st_mode):
            raise DeviceError(f"{path} is no device node: name a /dev/hidrawN, or leave `path` out")
        fcntl.ioctl(fd, _GET_INFO, info)
    except OSError as error:
        raise DeviceError(f"{path} is no hidraw node: {error.strerror}: name a /dev/hidrawN") from error
    _, vendor, product = struct.unpack("<IHH", info)
    if (vendor, product) != (wanted_vendor, wanted_product):
        raise DeviceError(
            f"{path} is the device {ids(vendor, product)}, and the rig is for "
            f"{ids(wanted_vendor, wanted_product)}: name the right node, or leave `path` out"
        )
