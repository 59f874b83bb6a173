"""Exclusive opening of a device node, used for hidraw nodes and serial ports."""

from __future__ import annotations

import errno
import fcntl
import os

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission
from softfinger.drivers.system import discovery


def open_locked(path: str, permit: str) -> int:
    """Open a node for reading and writing, non-blocking and locked, and return its file descriptor.

    permit  remedy for a missing permission, for the message

    Raises DeviceNotFound, DevicePermission, DeviceBusy or DeviceError.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError as error:
        raise _open_error(path, permit, error) from error
    try:
        _lock(fd, path)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _open_error(path: str, permit: str, error: OSError) -> DeviceError:
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
