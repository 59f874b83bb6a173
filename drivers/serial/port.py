"""Serial port of a device: found by its USB ids, opened exclusively, set to raw bytes; check of the line's speed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import sys
import termios
import time
from functools import partial
from typing import Final, get_args

from softfinger.config.errors import ConfigError, DeviceError, DeviceNotFound
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.serial.frames import FRAME_BYTES
from softfinger.drivers.serial.options import Baud, Options
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import explain_ambiguity, is_inverse3
from softfinger.drivers.system.nodes import format_ids, open_locked
from softfinger.drivers.system.rules import explain_permission

SERIAL_STRUCT_BYTES: Final = 72
FLAGS_AT: Final = 16
ASYNC_LOW_LATENCY: Final = 1 << 13
"""From linux/serial.h and tty_flags.h: struct serial_struct and the offset of its flags, on 64-bit machines."""
DRAIN_WAIT_S: Final = 0.2
"""Maximum time to send written bytes before the port is closed; the system's close would wait for 30 s."""


def open_port(options: Options) -> tuple[int, str]:
    """Open the device's port, raw, non-blocking, locked and empty, and return its file descriptor and path.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is not a port or another device.
    """
    path = options.path or find_port(options)
    _check_ids(path, options)
    fd = open_locked(path, _explain_permission(path, options))
    with undo_on_error(partial(os.close, fd)):
        if not os.isatty(fd):
            raise DeviceError(f"{path} is not a serial port: use a /dev/ttyACMN, or remove `path`")
        try:
            set_raw(fd, options.baud)
        except (OSError, termios.error) as error:
            raise DeviceError(f"{path} cannot be set to raw mode: {error}: plug the device in again") from error
    return fd, path


def close_port(fd: int) -> None:
    """Wait until written bytes are sent, then close; drop bytes that are not sent in time."""
    until = time.monotonic() + DRAIN_WAIT_S
    with contextlib.suppress(OSError, termios.error):  # disconnected already
        while count_unsent(fd) and time.monotonic() < until:
            time.sleep(0.001)
        if count_unsent(fd):  # only then: a last zero that is still being sent must not be dropped
            termios.tcflush(fd, termios.TCOFLUSH)
        fcntl.ioctl(fd, termios.TIOCNXCL)
    os.close(fd)


def count_unsent(fd: int) -> int:
    """Return the number of written bytes not sent yet; 1 if all of them are in the chip.

    Raises OSError if the port is disconnected. A pseudo terminal counts none; a USB modem counts too many.
    """
    queued = int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    if queued:
        return queued
    try:
        state = int.from_bytes(fcntl.ioctl(fd, termios.TIOCSERGETLSR, bytes(4)), sys.byteorder)
    except OSError:  # no UART, or a driver that does not support the request
        return 0
    return 0 if state & termios.TIOCSER_TEMT else 1


def find_port(options: Options) -> str:
    """Return the path of the port of the only device with the rig's ids.

    Raises DeviceNotFound if there is none or more than one, or if ids and product string do not identify the device:
    nothing is written to a port before the user has confirmed that it is the right one.
    """
    ports = list(discovery.iter_serial_ports())
    if options.vendor_id is None or options.product_id is None:
        attached = ", ".join(f"{port.node} ({port.ids}, {port.name})" for port in ports) or "no serial port on USB"
        raise DeviceNotFound(f"the rig does not set a port: set path under [device]; attached: {attached}")
    usb_ids = format_ids(options.vendor_id, options.product_id)
    with_ids = [port for port in ports if port.ids == usb_ids and not is_inverse3(port)]
    matching = [port for port in with_ids if options.serial in (None, port.serial)]
    if len(matching) == 1:
        ambiguity = explain_ambiguity(matching[0]) if options.serial is None else None
        if ambiguity is None:
            return matching[0].node
        raise DeviceNotFound(
            f"{matching[0].node} may be another device: {ambiguity}: if it is the right one, set path = "
            f'"{matching[0].node}" under [device] of the rig, or serial to its serial number'
        )
    if matching:
        choices = ", ".join(f"{port.node} (serial '{port.serial}')" for port in matching)
        raise DeviceNotFound(f"{len(matching)} serial ports are {usb_ids}: select one with serial or path: {choices}")
    if with_ids:
        serials = ", ".join(f"'{port.serial}'" for port in with_ids)
        raise DeviceNotFound(
            f"no serial port {usb_ids} has the serial number '{options.serial}': attached are {serials}"
        )
    ignored_ports = ", ".join(
        f"{'a Haply Inverse3' if is_inverse3(port) else port.name} ({port.ids}) at {port.node}" for port in ports
    )
    attached_text = f"attached are {ignored_ports}" if ports else "no USB serial port is attached"
    raise DeviceNotFound(
        f"no serial port {usb_ids} is attached: plug the device in and switch it on, correct vendor_id and product_id, "
        f"or set path to its port; {attached_text}"
    )


def _check_ids(path: str, options: Options) -> None:
    """Raise DeviceError if a port belongs to another USB device; a port that is not on USB has no ids to compare."""
    port = discovery.find_serial_port(path)
    if options.vendor_id is None or options.product_id is None:
        return
    usb_ids = format_ids(options.vendor_id, options.product_id)
    if port is not None and port.ids != usb_ids:
        raise DeviceError(
            f"{path} is the device {port.ids} ({port.name}), but the rig is for {usb_ids}: set path to the right "
            "port, or remove it"
        )
    if port is not None and is_inverse3(port):
        raise DeviceError(
            f"{path} is a Haply Inverse3 ('{port.name}'), which uses another protocol: set path to the right port"
        )


def _explain_permission(path: str, options: Options) -> str:
    if (group := discovery.find_group_with_access(path)) is not None:
        return f"run `sudo usermod -aG {group} $USER`, and log in again"
    if options.vendor_id is None or options.product_id is None:
        return "grant your user access to it"
    return explain_permission(options.vendor_id, options.product_id)


def set_raw(fd: int, baud: int) -> None:
    # `flock` excludes other instances of this program, TIOCEXCL every program that does not run as root
    fcntl.ioctl(fd, termios.TIOCEXCL)
    settings = termios.tcgetattr(fd)
    settings[0] = settings[1] = settings[3] = 0  # no translation, echo or line buffering
    settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL | termios.HUPCL
    settings[4] = settings[5] = getattr(termios, f"B{baud}")
    # With VMIN 0, a read without available bytes would return 0, as for a disconnected device.
    settings[6][termios.VMIN], settings[6][termios.VTIME] = 1, 0
    termios.tcsetattr(fd, termios.TCSANOW, settings)
    termios.tcflush(fd, termios.TCIOFLUSH)
    # A chip such as FTDI's then delivers bytes after 1 ms instead of 16; ports without such a timer reject it.
    with contextlib.suppress(OSError):
        timer = bytearray(fcntl.ioctl(fd, termios.TIOCGSERIAL, bytes(SERIAL_STRUCT_BYTES)))
        (flags,) = struct.unpack_from("i", timer, FLAGS_AT)
        struct.pack_into("i", timer, FLAGS_AT, flags | ASYNC_LOW_LATENCY)
        fcntl.ioctl(fd, termios.TIOCSSERIAL, bytes(timer))


BITS_PER_BYTE: Final = 10
"""8N1: a start bit, eight data bits, no parity, a stop bit."""
CHIPS: Final = {0x0403: "FTDI", 0x10C4: "Silicon Labs", 0x1A86: "WCH", 0x067B: "Prolific"}
"""USB vendors of chips that connect a UART."""


def has_rate(options: Options) -> bool:
    """Return True if the baud rate limits a rig's port; False for a board with USB, which ignores it.

    Such boards have ports named ttyACM. Other names starting with tty are lines; for the remaining ones the USB vendor
    decides. Without a vendor the port counts as a line.
    """
    name = os.path.basename(os.path.realpath(options.path)) if options.path else ""
    if name.startswith("tty"):
        return not name.startswith("ttyACM")
    return options.vendor_id is None or options.vendor_id in CHIPS


def check(options: Options, rate_hz: float, where: str) -> None:
    """Raise ConfigError if the line is too slow for a frame in each direction per tick.

    Parameters
    ----------
    options
        of the rig
    rate_hz
        ticks per second
    where
        file and table of the options, prefix of the message
    """
    if not has_rate(options):
        return
    spec = options.frames
    out, into = (FRAME_BYTES, FRAME_BYTES) if spec is None else (spec.output.bytes, spec.input.bytes)
    carries, needs = options.baud / BITS_PER_BYTE, max(out, into) * rate_hz
    if needs <= carries:
        return
    enough = [baud for baud in get_args(Baud) if baud / BITS_PER_BYTE >= needs]
    faster = f"set baud to {enough[0]} or more, here and in the firmware, " if enough else ""
    raise ConfigError(
        f"{where}.baud = {options.baud}: the line carries {carries:g} bytes/s each way, as a byte takes "
        f"{BITS_PER_BYTE} bits (8N1: a start bit, eight of data, a stop bit); a tick sends {out} bytes and receives "
        f"{into}, so servo.rate_hz = {rate_hz:g} needs {out * rate_hz:g} bytes/s to the board and {into * rate_hz:g} "
        f"from it, and forces would queue and arrive late: {faster}lower servo.rate_hz, and the rate of a board that "
        f"streams, to {int(carries / max(out, into))} Hz, or shorten the frames; a board with its own USB ignores "
        'baud: name its port, path = "/dev/ttyACMN"'
    )
