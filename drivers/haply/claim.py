"""Lock on a device at the service, because the service accepts forces of any number of programs and adds them up."""

from __future__ import annotations

import errno
import os
import socket
import struct
from typing import Final

from softfinger.config.errors import DeviceBusy, DeviceError
from softfinger.drivers.haply.messages import DeviceRef
from softfinger.drivers.system import discovery

_CREDENTIALS: Final = struct.Struct("3i")
"""Process, user and group of a peer."""


def claim(port: int, device: DeviceRef) -> socket.socket:
    """Lock a device of the service on `port`, until the returned socket is closed or this process ends.

    The lock is the name of an abstract Unix socket. Such names belong to a network namespace, like the service's port,
    and the system releases them however a process ends.

    Raises DeviceBusy if this or another process has locked the device, DeviceError if the system has no such names.
    """
    address = f"\0softfinger/haply/{port}/{device.group}/{device.name}"
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        lock.bind(address)
        lock.listen()
    except OSError as error:
        lock.close()
        if error.errno != errno.EADDRINUSE:
            raise DeviceError(f"{device} cannot be locked for this program: {error.strerror or error}") from error
        raise DeviceBusy(
            f"{device} at the Inverse Service on port {port} is in use by {_holder(address)}, and the forces of two "
            "programs would add up: end that one first, or name another device with device_id"
        ) from None
    return lock


def _holder(address: str) -> str:
    """Return the process that listens on a Unix socket, as text for messages."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address)
            pid, _, _ = _CREDENTIALS.unpack(probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
        except OSError:  # it has exited, or its connection queue is full
            pid = 0
    if pid <= 0:  # in another namespace
        return "another process"
    return "this program" if pid == os.getpid() else str(discovery.process(pid))
