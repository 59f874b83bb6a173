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
from softfinger.config.files import expanded, read_input
from softfinger.drivers.falcon import packets, usb
from softfinger.drivers.falcon.usb import Line

log: Final = logging.getLogger(__name__)

ROUNDS: Final = 1000
"""Exchanges without a valid reply after which no firmware runs in the device; each takes one or two milliseconds."""
GREETINGS: Final = 100
TRIES: Final = 10
"""Number of attempts to send the file; bytes are lost occasionally."""
CHUNK_BYTES: Final = 62
"""Bytes returned in one packet of the chip, without its status."""
ECHO_TRANSFERS: Final = 200
"""Maximum number of transfers for an echo, each of at least a millisecond; 62 bytes take 4 ms at 140000 baud."""
FILE_BYTES: Final = range(1000, 65537)
"""Accepted size of a file; known files have 7324 to 8492 bytes."""

GREETING, ANSWER = bytes.fromhex("0a430d"), bytes.fromhex("0a442c0d")
READY: Final = b"A"


def start(open_line: Callable[[], Line], path: str | None) -> Line:
    """Open a line to a device, send it the file at `path` if no firmware runs, and return the line in run mode.

    Raises the errors of `open_line`, and DeviceError if the file cannot be used or the device does not accept it.
    """
    line = open_line()
    try:
        line.run_mode()
        if runs(line):
            return line
        data = _file(path)
        for turn in range(TRIES):
            if turn > 0:
                line.close()
                line = open_line()
            fault = _send(line, data)
            if fault is None:
                line.run_mode()
                if runs(line):
                    log.info("Falcon: firmware %s runs", path)
                    return line
                fault = "it sends no valid reply once it has its firmware: is this a Falcon's firmware file"
            log.warning("Falcon: firmware, try %d of %d: %s", turn + 1, TRIES, fault)
    except BaseException:
        line.close()
        raise
    line.close()
    raise DeviceError(
        f"the Falcon did not take the firmware {path} in {TRIES} tries: {fault}: switch it off and on, check the "
        "file, then start again"
    )


def runs(line: Line) -> bool:
    """Return True if firmware answers a packet of zeros."""
    out, reply, fill = np.zeros(packets.SIZE, np.uint8), np.zeros(packets.SIZE, np.uint8), 0
    packets.encode((0, 0, 0), packets.RED, out)
    for _ in range(ROUNDS):
        line.write(out.tobytes())
        for byte in line.read(packets.SIZE, 1):
            fill, _ = packets.assemble(byte, fill, reply)
            if fill == packets.SIZE:
                line.purge()
                return True
    return False


def _file(path: str | None) -> bytes:
    if path is None:
        raise DeviceError(
            "no firmware runs in the Falcon: give the path of its firmware file as `firmware` in the rig's [device] "
            "table; the maker's drivers have the file (docs/devices/falcon.md), and it may not come with this program"
        )
    try:
        data = read_input(expanded(path), 1 << 20)
    except OSError as error:
        raise DeviceError(f"firmware = {path} cannot be read: {error.strerror}: correct the path in the rig") from error
    if len(data) not in FILE_BYTES:
        raise DeviceError(
            f"firmware = {path} has {len(data)} bytes, a Falcon's firmware 7324 to 8492: name the firmware file itself"
        )
    return data


def _send(line: Line, data: bytes) -> str | None:
    """Greet the boot loader and send the file; return a description of the failure, or None."""
    line.purge()
    for request, value in (
        (usb.LATENCY, usb.LATENCY_BOOT_MS),
        (usb.BAUD, usb.BAUD_9600),
        (usb.LINE, usb.LINE_8N1),
        (usb.FLOW, usb.NO_FLOW),
        (usb.MODEM, usb.RTS_LOW),
        (usb.MODEM, usb.DTR_LOW),
        (usb.MODEM, usb.DTR_HIGH),
    ):
        line.request(request, value)
    if not _greeted(line):
        return f"its boot loader does not answer {GREETINGS} greetings"
    line.request(usb.MODEM, usb.DTR_LOW)
    line.request(usb.BAUD, usb.BAUD_140000)
    line.write(READY)
    echo = line.read(len(READY), ECHO_TRANSFERS)
    if echo != READY:
        return f"its boot loader answers {echo.hex() or 'nothing'} and not {READY.hex()} at 140000 baud"
    for at in range(0, len(data), CHUNK_BYTES):
        chunk = data[at : at + CHUNK_BYTES]
        line.write(chunk)
        echo = line.read(len(chunk), ECHO_TRANSFERS)
        if echo != chunk:
            wrong = next((k for k, byte in enumerate(chunk) if echo[k : k + 1] != bytes([byte])), 0)
            return f"byte {at + wrong} of {len(data)} came back as {echo[wrong : wrong + 1].hex() or 'nothing'}"
    return None


def _greeted(line: Line) -> bool:
    for _ in range(GREETINGS):
        line.write(GREETING)
        answer = line.read(len(ANSWER), 2)
        if answer.startswith(b"\0"):  # noise byte from switching the line
            answer = answer[1:] + line.read(1, 1)
        if answer == ANSWER:
            return True
    return False
