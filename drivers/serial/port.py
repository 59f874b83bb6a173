"""The system's serial port of a device: found by its USB ids, opened for this process alone, set to raw bytes."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import sys
import termios
import time
from typing import Final

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.drivers.serial.options import Options
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import other_product, undecided
from softfinger.drivers.system.hidraw import ids
from softfinger.drivers.system.nodes import open_locked
from softfinger.drivers.system.rules import how_to_permit

TIOCGSERIAL: Final = 0x541E
TIOCSSERIAL: Final = 0x541F
SERIAL_STRUCT_BYTES: Final = 72
FLAGS_AT: Final = 16
ASYNC_LOW_LATENCY: Final = 1 << 13
"""Of linux/serial.h and tty_flags.h: struct serial_struct and where its flags are, on 64-bit machines."""
TIOCSERGETLSR: Final = 0x5459
TIOCSER_TEMT: Final = 1
"""Of asm/ioctls.h and linux/serial.h: state of a UART, and its bit for a transmitter that is empty."""
DRAIN_WAIT_S: Final = 0.2
"""How long what was written has to leave before the port is closed; the system's own close would wait for 30 s."""


def open_port(options: Options) -> tuple[int, str]:
    """File descriptor of the device's port, raw, non-blocking, locked, empty; and its path.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError when it is no port or another device.
    """
    if not sys.platform.startswith("linux"):
        raise DeviceError(f"driver 'serial' opens serial ports of Linux, and this is {sys.platform}")
    path = options.path or find(options)
    _check_ids(path, options)
    fd = open_locked(path, _how_to_permit(path, options))
    try:
        if not os.isatty(fd):
            raise DeviceError(f"{path} is no serial port: name a /dev/ttyACMN, or leave `path` out")
        try:
            _set_raw(fd, options.baud)
        except (OSError, termios.error) as error:
            raise DeviceError(f"{path} cannot be set to raw bytes: {error}: plug the device in again") from error
    except BaseException:
        os.close(fd)
        raise
    return fd, path


def close_port(fd: int) -> None:
    """Let what was written leave, then close; bytes that the device does not take in time are thrown away."""
    until = time.monotonic() + DRAIN_WAIT_S
    with contextlib.suppress(OSError, termios.error):  # gone already
        while count_unsent(fd) and time.monotonic() < until:
            time.sleep(0.001)
        if count_unsent(fd):  # and only then: a last zero that the system still hands on must not be thrown away
            termios.tcflush(fd, termios.TCOFLUSH)
        fcntl.ioctl(fd, termios.TIOCNXCL)
    os.close(fd)


def _set_low_latency(fd: int) -> None:
    """Have a chip such as FTDI's hand on bytes after 1 ms and not after 16; a port without such a timer refuses."""
    with contextlib.suppress(OSError):
        settings = bytearray(fcntl.ioctl(fd, TIOCGSERIAL, bytes(SERIAL_STRUCT_BYTES)))
        (flags,) = struct.unpack_from("i", settings, FLAGS_AT)
        struct.pack_into("i", settings, FLAGS_AT, flags | ASYNC_LOW_LATENCY)
        fcntl.ioctl(fd, TIOCSSERIAL, bytes(settings))


def count_unsent(fd: int) -> int:
    """Return the bytes written that have not gone out, 1 for those that only the chip still has.

    Raises OSError if the port is gone. A pseudo terminal counts none; a USB modem more than there are.
    """
    queued = int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    if queued:
        return queued
    try:
        state = int.from_bytes(fcntl.ioctl(fd, TIOCSERGETLSR, bytes(4)), sys.byteorder)
    except OSError:  # no UART, or a driver that does not know of one
        return 0
    return 0 if state & TIOCSER_TEMT else 1


def find(options: Options) -> str:
    """Path of the port of the one device with the rig's ids.

    Raises DeviceNotFound when there is none or more than one, or when ids and product string do not tell what it is:
    a port is not written to before somebody has said that it is the right one.
    """
    ports = list(discovery.serial_ports())
    if options.vendor_id is None or options.product_id is None:
        seen = ", ".join(f"{port.node} ({port.ids}, {port.name})" for port in ports) or "no serial port on USB"
        raise DeviceNotFound(f"the rig does not say which port: name it with path under [device]; attached: {seen}")
    wanted = ids(options.vendor_id, options.product_id)
    theirs = [port for port in ports if port.ids == wanted and other_product(port) is None]
    matching = [port for port in theirs if options.serial in (None, port.serial)]
    if len(matching) == 1:
        why = undecided(matching[0]) if options.serial is None else None
        if why is None:
            return matching[0].node
        raise DeviceNotFound(
            f"{matching[0].node} may be the device or not: {why}: if it is the one, name its port with path = "
            f'"{matching[0].node}" under [device] of the rig, or its serial number with serial'
        )
    if matching:
        listed = ", ".join(f"{port.node} (serial '{port.serial}')" for port in matching)
        raise DeviceNotFound(f"{len(matching)} serial ports are {wanted}: name one with serial or path: {listed}")
    if theirs:
        serials = ", ".join(f"'{port.serial}'" for port in theirs)
        raise DeviceNotFound(
            f"no serial port {wanted} has the serial number '{options.serial}': attached are {serials}"
        )
    others = ", ".join(f"{other_product(port) or port.name} ({port.ids}) at {port.node}" for port in ports)
    there = f"attached are {others}" if ports else "no serial port on USB is attached"
    raise DeviceNotFound(
        f"no serial port {wanted} is attached: plug the device in and switch it on, correct vendor_id and product_id, "
        f"or name its port with path; {there}"
    )


def _check_ids(path: str, options: Options) -> None:
    """DeviceError when a port belongs to another USB device; one that is not on USB has no ids to compare."""
    port = discovery.serial_port(path)
    if options.vendor_id is None or options.product_id is None:
        return
    wanted = ids(options.vendor_id, options.product_id)
    if port is not None and port.ids != wanted:
        raise DeviceError(
            f"{path} is the device {port.ids} ({port.name}), and the rig is for {wanted}: name the right port, or "
            "leave `path` out"
        )
    if port is not None and (other := other_product(port)) is not None:
        raise DeviceError(f"{path} is {other} ('{port.name}'), which speaks another language: name the right port")


def _how_to_permit(path: str, options: Options) -> str:
    if (group := discovery.group_with_access(path)) is not None:
        return f"run `sudo usermod -aG {group} $USER`, and log in again"
    if options.vendor_id is None or options.product_id is None:
        return "give your user the right to open it"
    return how_to_permit(options.vendor_id, options.product_id)


def _set_raw(fd: int, baud: int) -> None:
    # `flock` keeps our own programs out, this one everything that does not run as root.
    fcntl.ioctl(fd, termios.TIOCEXCL)
    settings = termios.tcgetattr(fd)
    settings[0] = settings[1] = settings[3] = 0  # nothing is translated, echoed or held back
    settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL | termios.HUPCL
    settings[4] = settings[5] = getattr(termios, f"B{baud}")
    # Without a byte to wait for, a read with nothing there would return 0, as if the device were gone.
    settings[6][termios.VMIN], settings[6][termios.VTIME] = 1, 0
    termios.tcsetattr(fd, termios.TCSANOW, settings)
    termios.tcflush(fd, termios.TCIOFLUSH)
    _set_low_latency(fd)
