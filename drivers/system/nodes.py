"""Exclusive opening of a device node, a serial port or a hidraw node, with a check that it is the intended device."""

from __future__ import annotations

import errno
import fcntl
import importlib
import os
import stat
import struct
from functools import partial
from typing import Any, Final

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.system import discovery
from softfinger.drivers.system.rules import explain_permission


def open_locked(path: str, permit: str) -> int:
    """Open a node for reading and writing, non-blocking and locked, and return its file descriptor.

    permit  remedy for a missing permission, for the message

    Raises DeviceNotFound, DevicePermission, DeviceBusy or DeviceError.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError as error:
        raise _make_open_error(path, permit, error) from error
    with undo_on_error(partial(os.close, fd)):
        _lock(fd, path)
    return fd


def _make_open_error(path: str, permit: str, error: OSError) -> DeviceError:
    reason = error.strerror or str(error)
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceNotFound(f"{path} cannot be opened: {reason}: plug the device in, or remove `path`")
    if error.errno in (errno.EACCES, errno.EPERM):
        return DevicePermission(f"{path} may not be opened by this user: {reason}: {permit}")
    if error.errno == errno.EBUSY:
        return _make_busy_error(path)
    return DeviceError(f"{path} cannot be opened: {reason}")


def _lock(fd: int, path: str) -> None:
    # The system lets any number of programs write to a device; two that command forces would interfere.
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise _make_busy_error(path) from error
    except OSError:
        pass  # a node on a file system without locks


def _make_busy_error(path: str) -> DeviceBusy:
    return DeviceBusy(f"{path} is used by {discovery.find_holder(path) or 'another process'}: end that process first")


_GET_INFO: Final = 0x80084803  # an ioctl request of <linux/hidraw.h>


def open_path(path: str, vendor: int, product: int) -> int:
    """Open the node of a device with these ids, non-blocking and locked, and return its file descriptor.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is another device.
    """
    fd = open_locked(path, explain_permission(vendor, product))
    with undo_on_error(partial(os.close, fd)):
        _check_device(fd, path, vendor, product)
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


def format_ids(vendor: int, product: int) -> str:
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
            f"{path} is the device {format_ids(vendor, product)}, but the rig is for "
            f"{format_ids(wanted_vendor, wanted_product)}: set path to the right node, or remove it"
        )
