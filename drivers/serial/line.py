"""Check that a serial line is fast enough for the frames of every tick."""

from __future__ import annotations

import os
from typing import Final, get_args

from softfinger.config.errors import ConfigError
from softfinger.drivers.serial.frames import FRAME_BYTES
from softfinger.drivers.serial.options import Baud, Options

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


def count_frame_bytes(options: Options) -> tuple[int, int]:
    """Return the length of a frame to the board, and of one from it."""
    spec = options.frames
    return (FRAME_BYTES, FRAME_BYTES) if spec is None else (spec.output.bytes, spec.input.bytes)


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
    out, into = count_frame_bytes(options)
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
