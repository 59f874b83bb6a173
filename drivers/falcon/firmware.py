"""Start of the Falcon: check whether firmware runs, and send the user's file if not.

After power-on the device has no firmware. Its boot loader receives one over the serial line, and returns every byte.
The licence of the existing files forbids redistribution, so this program includes none.

Source: the boot sequence of libnifalcon.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

import numpy as np

from softfinger.config.errors import DeviceError
from softfinger.config.files import expand_home, read_input
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.falcon import packets, usb
from softfinger.drivers.falcon.usb import SerialChip

log: Final = logging.getLogger(__name__)

PROBES_MAX: Final = 1000
"""Number of exchanges without a valid reply that prove that no firmware runs; each takes one or two milliseconds."""
GREETINGS_MAX: Final = 100
ATTEMPTS_MAX: Final = 10
"""Number of attempts to send the file; bytes are lost occasionally."""
CHUNK_BYTES: Final = 62
"""Bytes returned in one packet of the chip, without its status."""
ECHO_TRANSFERS: Final = 200
"""Maximum number of transfers for an echo, each of at least a millisecond; 62 bytes take 4 ms at 140000 baud."""
FILE_BYTES: Final = range(1000, 65537)
"""Accepted size of a file; known files have 7324 to 8492 bytes."""

GREETING, ANSWER = bytes.fromhex("0a430d"), bytes.fromhex("0a442c0d")
READY: Final = b"A"


def start_firmware(open_chip: Callable[[], SerialChip], path: str | None) -> SerialChip:
    """Open a line to a device, send it the file at `path` if no firmware runs, and return the line in run mode.

    Raises the errors of `open_chip`, and DeviceError if the file cannot be used or the device does not accept it.
    """
    chip = open_chip()
    with undo_on_error(lambda: chip.close()):
        chip.set_run_mode()
        if has_firmware(chip):
            return chip
        data = _read_firmware(path)
        for attempt in range(ATTEMPTS_MAX):
            if attempt > 0:
                chip.close()
                chip = open_chip()
            fault = _send(chip, data)
            if fault is None:
                chip.set_run_mode()
                if has_firmware(chip):
                    log.info("Falcon: firmware %s runs", path)
                    return chip
                fault = "it sends no valid reply with this firmware; check that the file is for the Falcon"
            log.warning("Falcon: firmware, try %d of %d: %s", attempt + 1, ATTEMPTS_MAX, fault)
        raise DeviceError(
            f"the Falcon did not accept the firmware {path} in {ATTEMPTS_MAX} tries: {fault}: switch it off and on, "
            "check the file, then start again"
        )


def has_firmware(chip: SerialChip) -> bool:
    """Return True if firmware answers a packet of zeros."""
    out, reply, fill = np.zeros(packets.SIZE, np.uint8), np.zeros(packets.SIZE, np.uint8), 0
    packets.encode((0, 0, 0), packets.RED, out)
    for _ in range(PROBES_MAX):
        chip.write(out.tobytes())
        for byte in chip.read(packets.SIZE, 1):
            fill, _ = packets.assemble(byte, fill, reply)
            if fill == packets.SIZE:
                chip.purge()
                return True
    return False


def _read_firmware(path: str | None) -> bytes:
    if path is None:
        raise DeviceError(
            "no firmware runs in the Falcon: set `firmware` in the rig's [device] table to its firmware file; the file "
            "is part of the maker's drivers (docs/devices/falcon.md) and may not be distributed with this program"
        )
    try:
        data = read_input(expand_home(path), 1 << 20)
    except OSError as error:
        raise DeviceError(f"firmware = {path} cannot be read: {error.strerror}: correct the path in the rig") from error
    if len(data) not in FILE_BYTES:
        raise DeviceError(
            f"firmware = {path} has {len(data)} bytes, must have 7324 to 8492: name the firmware file itself"
        )
    return data


def _send(chip: SerialChip, data: bytes) -> str | None:
    """Greet the boot loader and send the file; return a description of the failure, or None."""
    chip.purge()
    for request, value in (
        (usb.LATENCY, usb.LATENCY_BOOT_MS),
        (usb.BAUD, usb.BAUD_9600),
        (usb.LINE, usb.LINE_8N1),
        (usb.FLOW, usb.NO_FLOW),
        (usb.MODEM, usb.RTS_LOW),
        (usb.MODEM, usb.DTR_LOW),
        (usb.MODEM, usb.DTR_HIGH),
    ):
        chip.request(request, value)
    if not _greet(chip):
        return f"its boot loader does not answer {GREETINGS_MAX} greetings"
    chip.request(usb.MODEM, usb.DTR_LOW)
    chip.request(usb.BAUD, usb.BAUD_140000)
    chip.write(READY)
    echo = chip.read(len(READY), ECHO_TRANSFERS)
    if echo != READY:
        return f"its boot loader answers {echo.hex() or 'nothing'} instead of {READY.hex()} at 140000 baud"
    for at in range(0, len(data), CHUNK_BYTES):
        chunk = data[at : at + CHUNK_BYTES]
        chip.write(chunk)
        echo = chip.read(len(chunk), ECHO_TRANSFERS)
        if echo != chunk:
            wrong = next((k for k, byte in enumerate(chunk) if echo[k : k + 1] != bytes([byte])), 0)
            return f"byte {at + wrong} of {len(data)} was returned as {echo[wrong : wrong + 1].hex() or 'nothing'}"
    return None


def _greet(chip: SerialChip) -> bool:
    for _ in range(GREETINGS_MAX):
        chip.write(GREETING)
        answer = chip.read(len(ANSWER), 2)
        if answer.startswith(b"\0"):  # noise byte from switching the line
            answer = answer[1:] + chip.read(1, 1)
        if answer == ANSWER:
            return True
    return False
