"""Packets of the Falcon: 16 bytes in each direction; the device answers each of the host's with one.

    '<'  n1 n1 n1 n1  n2 n2 n2 n2  n3 n3 n3 n3  state  'A'  '>'

n1 to n3 are int16, one nibble per byte as 'A' + nibble, the least significant first: motor counts to the device,
encoder counts from it. `state` is 'A' + bits: lights and homing request to the device; buttons and homed motors from
it.

Source: the wire format of libnifalcon.
"""

from __future__ import annotations

from typing import Any, Final

from softfinger.proxy.kernels.jit.decorators import jit

CHIP_BYTES: Final = 64
"""Size of a USB packet from the serial chip."""
STATUS_BYTES: Final = 2
"""Modem status before the data of each of these."""

SIZE: Final = 16
STATE: Final = 13
"""Index of the byte with state bits."""
FILLER: Final = 14

HOMING: Final = 1
"""To the device: find the zeros of the encoders."""
GREEN: Final = 2
BLUE: Final = 4
RED: Final = 8

BUTTONS: Final = 15
"""From the device: plus 1, forward 2, centre 4, minus 8."""
HOMED: Final = 0x70
"""From the device: a bit for each motor whose encoder has found its zero."""

COUNT_MAX: Final = 4095
"""Maximum motor count."""

_OPEN, _CLOSE, BASE = 0x3C, 0x3E, 0x41

Counts = tuple[int, int, int]


@jit
def encode(motors: Counts, state: int, out: Any) -> None:
    """Encode motor counts (3,) and bits `state` as a packet in `out` (16,) uint8."""
    out[0] = _OPEN
    for i in range(3):
        for k in range(4):
            out[1 + 4 * i + k] = BASE + ((motors[i] >> (4 * k)) & 15)
    out[STATE] = BASE + state
    out[FILLER] = BASE
    out[SIZE - 1] = _CLOSE


@jit
def _count(packet: Any, at: int) -> int:
    value = 0
    for k in range(4):
        value |= (int(packet[at + k]) - BASE) << (4 * k)
    return value - 0x10000 if value >= 0x8000 else value


@jit
def decode(packet: Any) -> tuple[Counts, int]:
    """Decode a complete packet (16,) uint8 from `assemble`; return encoder counts (3,) and state bits."""
    return (_count(packet, 1), _count(packet, 5), _count(packet, 9)), int(packet[STATE]) - BASE


@jit
def assemble(byte: int, fill: int, packet: Any) -> tuple[int, bool]:
    """Add one byte of the stream to `packet` (16,) uint8, which has `fill` bytes.

    returns  the new fill, and True if earlier bytes were dropped because they are no packet. At fill 16 the packet is
             complete; the caller processes it and continues with 0.

    A '<' appears only at the start of a packet, so it always starts one.
    """
    if byte == _OPEN:
        packet[0] = byte
        return 1, fill > 0
    if fill == 0:
        return 0, True
    if fill < STATE:
        good = BASE <= byte < BASE + 16
    elif fill == STATE:
        good = BASE <= byte < BASE + 128
    elif fill == FILLER:
        good = True  # without content, and not documented to be constant
    else:
        good = byte == _CLOSE
    if not good:
        return 0, True
    packet[fill] = byte
    return fill + 1, False
