"""The Falcon's packets: 16 bytes each way, one of the host's answered by one of the device's.

    '<'  n1 n1 n1 n1  n2 n2 n2 n2  n3 n3 n3 n3  state  'A'  '>'

n1 to n3 are int16, a nibble to a byte as 'A' + nibble, the least significant first: motor counts to the device,
encoder counts from it. `state` is 'A' + bits: lights and the homing request out; buttons and homed motors in.

Source: the wire format of libnifalcon.
"""

from __future__ import annotations

from typing import Any, Final

from softfinger.proxy.kernels.jit.decorators import jit

SIZE: Final = 16
STATE: Final = 13
"""Place of the byte of bits."""
FILLER: Final = 14

HOMING: Final = 1
"""Out: ask the device to find the places of its encoders' zeros."""
GREEN: Final = 2
BLUE: Final = 4
RED: Final = 8

BUTTONS: Final = 15
"""In: plus 1, forward 2, centre 4, minus 8."""
HOMED: Final = 0x70
"""In: a bit for each motor whose encoder has found its zero."""

COUNT_MAX: Final = 4095
"""Largest motor count."""

_OPEN, _CLOSE, BASE = 0x3C, 0x3E, 0x41

Counts = tuple[int, int, int]


@jit
def encode(motors: Counts, state: int, out: Any) -> None:
    """Write the packet for motor counts (3,) and bits `state` to `out` (16,) uint8."""
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
    """Encoder counts (3,) and bits of a packet (16,) uint8 that `assemble` has found to be one."""
    return (_count(packet, 1), _count(packet, 5), _count(packet, 9)), int(packet[STATE]) - BASE


@jit
def assemble(byte: int, fill: int, packet: Any) -> tuple[int, bool]:
    """Take one byte of the stream into `packet` (16,) uint8, of which `fill` are there.

    returns  the new fill, and whether what was there is thrown away because it cannot be a packet. At fill 16 the
             packet is whole; the caller takes it and goes on with 0.

    A '<' is in no other place of a packet, so it always begins one.
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
        good = True  # it carries nothing, and nobody has said that it is always the same
    else:
        good = byte == _CLOSE
    if not good:
        return 0, True
    packet[fill] = byte
    return fill + 1, False
