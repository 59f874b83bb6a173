"""Text frames: eight numbers from the device, seven to it, in 64 bytes that end with a newline.

    from the device   x y z (mm)  tA lambda tD tE (rad)  info        "  -59.276   13.383 -148.002  0.0919 ..."
    to the device     fx fy fz (mN)  2 0 0 0                         "100 -20 5 2 0 0 0        ..."

Numbers are decimal and separated by blanks. Blanks and a newline before the padding may follow the last one: the
device's firmware prints them.

Source of the format and of the angles' unit: forsslund/haptikfabrikenapi, src/uhaptikfabriken.h, which passes the
angles to sin and cos unchanged.
"""

from __future__ import annotations

from math import floor
from typing import Any, Final

from numba import types

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import uint8_at
from softfinger.proxy.kernels.model import Vec3

FRAME_BYTES: Final = 64
NEWLINE: Final = 10

# Indices of the numbers in the device's frame.
POSITION: Final = 0
ANGLES: Final = 3
INFO: Final = 7
NUMBERS: Final = 8

DIGITS_MAX: Final = 12
"""Maximum digits of a number: an integer and a power of ten of this size are exact, and one division rounds."""
REACH_MM: Final = 10_000.0
"""Limit of a coordinate, beyond the reach of any desktop device."""
ANGLE_MAX_RAD: Final = 100.0
"""Limit of an angle, sixteen turns: beyond the range of any joint of an arm with cables."""
INFO_MAX: Final = 32768.0
"""Limit of a two-byte number."""
MILLI: Final = 1000.0
FORCE_COMMAND: Final = 2
"""Value of the fourth number to the device: the first three are forces."""
ZERO: Final = f"0 0 0 {FORCE_COMMAND} 0 0 0".ljust(FRAME_BYTES - 1).encode() + bytes([NEWLINE])
"""Frame that commands zero force."""
LOOKBACK: Final = FRAME_BYTES
"""Bytes before the new ones: a partial frame, and the newline before it."""

_BLANK: Final = 32
_PLUS: Final = 43
_MINUS: Final = 45
_POINT: Final = 46
_ZERO: Final = 48


@jit
def decode(frame: int, values: Any) -> bool:
    """Decode the frame at address `frame` into `values` (NUMBERS,), in mm and rad; return False if it is invalid.

    Numbers consist of decimal digits. An exponent, nan, inf, more than DIGITS_MAX digits, a missing or additional
    number, any other byte, and a number beyond its limit make a frame invalid.
    """
    text = uint8_at(frame)
    if text[FRAME_BYTES - 1] != NEWLINE:
        return False
    at = 0  # never passes the last byte, which is neither blank nor digit
    for n in range(NUMBERS):
        while text[at] == _BLANK:
            at += 1
        negative = text[at] == _MINUS
        if negative or text[at] == _PLUS:
            at += 1
        mantissa, digits, scale, in_fraction = 0, 0, 1.0, False
        while True:
            digit = int(text[at]) - _ZERO
            if 0 <= digit <= 9:
                mantissa = 10 * mantissa + digit
                digits += 1
                if in_fraction:
                    scale *= 10.0
                if digits > DIGITS_MAX:
                    return False
            elif text[at] == _POINT and not in_fraction and n != INFO:
                in_fraction = True
            else:
                break
            at += 1
        if digits == 0 or not (text[at] == _BLANK or (n == INFO and text[at] == NEWLINE)):
            return False
        value = mantissa / scale
        if value > (REACH_MM if n < ANGLES else ANGLE_MAX_RAD if n < INFO else INFO_MAX):
            return False
        values[n] = -value if negative else value
    while text[at] == _BLANK or (text[at] == NEWLINE and at < FRAME_BYTES - 1):
        at += 1
    return at == FRAME_BYTES - 1


@jit
def decode_stream(buffer: int, count: int, scratch: Any, latest: Any) -> int:
    """Decode the frames that `count` new bytes complete; return their number and store the last one in `latest`.

    buffer   address of LOOKBACK earlier bytes followed by the new ones; the last LOOKBACK are moved to its front
    scratch  (NUMBERS,)

    A frame is the text between two newlines 64 bytes apart, so that the next complete frame is found after lost,
    duplicated or added bytes. Damaged frames have another length, or other than eight numbers, except in the rare case
    that parts of two frames have 64 bytes. A wrong digit is not detected, because frames have no checksum.
    """
    text, frames = uint8_at(buffer), 0
    for k in range(count):
        if text[k] == NEWLINE and text[k + LOOKBACK] == NEWLINE and decode(buffer + k + 1, scratch):
            frames += 1
            for n in range(NUMBERS):
                latest[n] = scratch[n]
    for k in range(LOOKBACK):
        text[k] = text[count + k]
    return frames


@jit
def _write_integer(text: Any, at: int, value: int) -> int:
    """Write an integer of at most five digits, and return the index after it."""
    if value < 0:
        text[at] = _MINUS
        at += 1
        value = -value
    unit = 10_000
    while unit > 1 and value < unit:
        unit //= 10
    while unit > 0:
        text[at] = types.uint8(_ZERO + value // unit % 10)
        at += 1
        unit //= 10
    return at


@jit
def encode(force: Vec3, frame: int) -> None:
    """Encode a force (N, within options.FORCE_MAX_N) as the frame at address `frame`, rounded to mN."""
    text, at = uint8_at(frame), 0
    for k in range(3):
        at = _write_integer(text, at, floor(MILLI * force[k] + 0.5))
        text[at] = _BLANK
        at += 1
    at = _write_integer(text, at, FORCE_COMMAND)
    for _ in range(3):
        text[at] = _BLANK
        text[at + 1] = _ZERO
        at += 2
    while at < FRAME_BYTES - 1:
        text[at] = _BLANK
        at += 1
    text[FRAME_BYTES - 1] = NEWLINE
