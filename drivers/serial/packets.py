"""Frames of bytes that a rig describes: found in a stream, checked, written.

A frame has its length, bytes that are always the same (`start` and `end`), and a checksum if the rig names one. Where
there is a checksum, or both a start and an end, a frame is looked for at every byte, so that after bytes lost, doubled
or torn the next whole frame is found again. An answer that has neither is known by its length alone: it is taken when
just as many bytes have come since the request as whole answers have, and refused otherwise.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.drivers.fields.table import SENSED_SIZE, decode
from softfinger.drivers.serial.options import CHECKS, Frame
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.memory import int64_at, uint8_at

# Words of a shape: bytes of the frame, kind of checksum, its offset and the first byte that it covers, whether its high
# byte comes first, and then for each byte what it always is, -1 where it may be anything.
BYTES: Final = 0
KIND: Final = 1
AT_BYTE: Final = 2
FIRST: Final = 3
BIG: Final = 4
FIXED: Final = 5

_SUM8: Final = CHECKS.index("sum8")
_XOR8: Final = CHECKS.index("xor8")
_CRC8: Final = CHECKS.index("crc8")
_CCITT: Final = CHECKS.index("crc16-ccitt")
_MODBUS: Final = CHECKS.index("crc16-modbus")


def shape_of(frame: Frame, big_endian: bool) -> NDArray[np.int64]:
    """The words of a frame's shape."""
    check = frame.check
    words = [frame.bytes, -1, 0, 0, int(big_endian)]
    if check is not None:
        words[KIND:BIG] = [CHECKS.index(check.kind), check.offset, check.first]
    fixed = [-1] * frame.bytes
    fixed[: len(frame.start)] = frame.start
    fixed[frame.bytes - len(frame.end) :] = frame.end
    return np.array([*words, *fixed], dtype=np.int64)


@jit
def checksum(frame: int, shape: int) -> int:
    """The checksum of the frame at an address: of its bytes from `first` up to the checksum itself."""
    text, s = uint8_at(frame), int64_at(shape)
    kind, crc = s[KIND], 0
    if kind in (_CCITT, _MODBUS):
        crc = 0xFFFF
    for k in range(s[FIRST], s[AT_BYTE]):
        byte = int(text[k])
        if kind == _SUM8:
            crc = (crc + byte) & 0xFF
        elif kind == _XOR8:
            crc ^= byte
        elif kind == _CRC8:
            crc ^= byte
            for _ in range(8):
                crc = ((crc << 1) ^ 0x07 if crc & 0x80 else crc << 1) & 0xFF
        elif kind == _CCITT:
            crc ^= byte << 8
            for _ in range(8):
                crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        else:
            crc ^= byte
            for _ in range(8):
                crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


@jit
def _place(shape: int, high: bool) -> int:
    """Where the low or the high byte of a checksum of two bytes is."""
    s = int64_at(shape)
    return int(s[AT_BYTE] + (1 if (s[BIG] != 0) != high else 0))


@jit
def fits(frame: int, shape: int) -> bool:
    """Whether the bytes at an address have what is always the same, and the checksum."""
    text, s = uint8_at(frame), int64_at(shape)
    for k in range(s[BYTES]):
        if s[FIXED + k] >= 0 and text[k] != s[FIXED + k]:
            return False
    if s[KIND] < 0:
        return True
    crc = checksum(frame, shape)
    if s[KIND] in (_CCITT, _MODBUS):
        return bool(text[_place(shape, False)] == crc & 0xFF and text[_place(shape, True)] == crc >> 8)
    return bool(text[s[AT_BYTE]] == crc)


@jit
def finish(frame: int, shape: int) -> None:
    """Put what is always the same, and the checksum, into the frame at an address."""
    text, s = uint8_at(frame), int64_at(shape)
    for k in range(s[BYTES]):
        if s[FIXED + k] >= 0:
            text[k] = types.uint8(s[FIXED + k])
    if s[KIND] < 0:
        return
    crc = checksum(frame, shape)
    if s[KIND] in (_CCITT, _MODBUS):
        text[_place(shape, False)] = types.uint8(crc & 0xFF)
        text[_place(shape, True)] = types.uint8(crc >> 8)
    else:
        text[s[AT_BYTE]] = types.uint8(crc)


@jit
def _accept(frame: int, shape: int, fields: int, rows: int, scratch: int, spare: Any, newest: Any) -> bool:
    """Read a frame into `newest`, if it is one."""
    if not (fits(frame, shape) and decode(frame, fields, rows, scratch, spare)):
        return False
    for n in range(SENSED_SIZE):
        newest[n] = spare[n]
    return True


@jit
def take(
    buffer: int, filled: Any, aligned: bool, shape: int, table: tuple[int, int, int], numbers: tuple[Any, Any]
) -> int:
    """How many frames are in the bytes at `buffer`; the last one's numbers in `numbers[1]`.

    filled   (1,) int64: how many bytes; what may still belong to a frame is moved to the front, and counted
    aligned  answers without a checksum, which begin where the request was sent
    table    addresses of rows, number of rows, and address of one int64 word
    numbers  (SENSED_SIZE,) each, the first overwritten
    """
    size, count, text = int64_at(shape)[BYTES], filled[0], uint8_at(buffer)
    fields, rows, scratch = table
    spare, newest = numbers
    frames, at = 0, 0
    if aligned:
        if count >= size and count % size == 0:
            whole = True
            while at < count and whole:
                whole = fits(buffer + at, shape)
                at += size
            if whole and _accept(buffer + count - size, shape, fields, rows, scratch, spare, newest):
                frames = count // size
            at = count
        elif count > 2 * size:
            at = count
    else:
        while count - at >= size:
            if _accept(buffer + at, shape, fields, rows, scratch, spare, newest):
                frames += 1
                at += size
            else:
                at += 1
    for k in range(count - at):
        text[k] = text[at + k]
    filled[0] = count - at
    return frames


@entry
def finish_once(frame: NDArray[np.uint8], shape: NDArray[np.int64]) -> None:
    """`finish` for Python."""
    finish(frame.ctypes.data, shape.ctypes.data)
