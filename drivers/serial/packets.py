"""Frames of bytes that a rig describes: search in a stream, check, and encoding.

A frame has a fixed length, fixed bytes (`start` and `end`), and optionally a checksum. With a checksum, or with both
start and end, the search tries every byte, so that it finds the next complete frame after lost, duplicated or torn
bytes. An answer without either is recognized by its length: it is accepted if the number of bytes since the request is
a multiple of the length, and rejected otherwise.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.drivers.fields.table import SENSED_SIZE, decode
from softfinger.drivers.serial.options import CHECK_BYTES, CHECKS, Frame
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import int64_at, uint8_at

# Entries of a shape: bytes of the frame, kind of checksum, its offset, the first byte that it covers, its bytes (0: no
# checksum), 1 if its high byte is first, then the fixed value of each byte, or -1.
BYTES: Final = 0
CHECK_KIND: Final = 1
CHECK_OFFSET: Final = 2
CHECK_FIRST: Final = 3
CHECK_SIZE: Final = 4
IS_BIG_ENDIAN: Final = 5
FIXED_BYTES: Final = 6

_SUM8: Final = CHECKS.index("sum8")
_XOR8: Final = CHECKS.index("xor8")
_CRC8: Final = CHECKS.index("crc8")
_CCITT: Final = CHECKS.index("crc16-ccitt")
_MODBUS: Final = CHECKS.index("crc16-modbus")


def make_shape(frame: Frame, big_endian: bool) -> NDArray[np.int64]:
    """Return the shape of a frame for the kernels."""
    check, checked = frame.check, [-1, 0, 0, 0]
    if check is not None:
        checked = [CHECKS.index(check.kind), check.offset, check.first, CHECK_BYTES[check.kind]]
    fixed = [-1] * frame.bytes
    fixed[: len(frame.start)] = frame.start
    fixed[frame.bytes - len(frame.end) :] = frame.end
    return np.array([frame.bytes, *checked, int(big_endian), *fixed], dtype=np.int64)


@jit
def compute_checksum(frame: int, shape: int) -> int:
    """Return the checksum of the frame at an address, over its bytes from `first` to the checksum."""
    text, s = uint8_at(frame), int64_at(shape)
    kind, crc = s[CHECK_KIND], 0
    if kind in (_CCITT, _MODBUS):
        crc = 0xFFFF
    for k in range(s[CHECK_FIRST], s[CHECK_OFFSET]):
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
def _check_index(shape: int, k: int) -> int:
    """Return the index of byte `k` of a checksum, the lowest first."""
    s = int64_at(shape)
    return int(s[CHECK_OFFSET] + (s[CHECK_SIZE] - 1 - k if s[IS_BIG_ENDIAN] != 0 else k))


@jit
def is_frame(frame: int, shape: int) -> bool:
    """Return True if the bytes at an address have the fixed bytes and the checksum of a frame."""
    text, s = uint8_at(frame), int64_at(shape)
    for k in range(s[BYTES]):
        if s[FIXED_BYTES + k] >= 0 and text[k] != s[FIXED_BYTES + k]:
            return False
    is_valid, crc = True, compute_checksum(frame, shape)
    for k in range(s[CHECK_SIZE]):
        is_valid = is_valid and text[_check_index(shape, k)] == crc >> (8 * k) & 0xFF
    return is_valid


@jit
def complete_frame(frame: int, shape: int) -> None:
    """Write the fixed bytes and the checksum into the frame at an address."""
    text, s = uint8_at(frame), int64_at(shape)
    for k in range(s[BYTES]):
        if s[FIXED_BYTES + k] >= 0:
            text[k] = types.uint8(s[FIXED_BYTES + k])
    crc = compute_checksum(frame, shape)
    for k in range(s[CHECK_SIZE]):
        text[_check_index(shape, k)] = types.uint8(crc >> (8 * k) & 0xFF)


@jit
def _accept(frame: int, shape: int, fields: int, rows: int, scratch: int, decoded: Any, latest: Any) -> bool:
    """Decode a frame into `latest` and return True, if it is valid."""
    if not (is_frame(frame, shape) and decode(frame, fields, rows, scratch, decoded)):
        return False
    for n in range(SENSED_SIZE):
        latest[n] = decoded[n]
    return True


@jit
def decode_stream(
    buffer: int, filled: Any, by_length: bool, shape: int, table: tuple[int, int, int], numbers: tuple[Any, Any]
) -> int:
    """Decode the frames in the bytes at `buffer`; return their number and store the last one in `numbers[1]`.

    filled     (1,) int64: number of bytes; bytes of an incomplete frame are moved to the front and counted here
    by_length  True for answers without a checksum, which are recognised by their length: they start after the request
    table      address of the rows, number of rows, and address of one int64 for scratch
    numbers    (SENSED_SIZE,) each, the first for scratch
    """
    size, count, text = int64_at(shape)[BYTES], filled[0], uint8_at(buffer)
    fields, rows, scratch = table
    decoded, latest = numbers
    frames, at = 0, 0
    if by_length:
        if count >= size and count % size == 0:
            is_valid = True
            while at < count and is_valid:
                is_valid = is_frame(buffer + at, shape)
                at += size
            if is_valid and _accept(buffer + count - size, shape, fields, rows, scratch, decoded, latest):
                frames = count // size
            at = count
        elif count > 2 * size:
            at = count
    else:
        while count - at >= size:
            if _accept(buffer + at, shape, fields, rows, scratch, decoded, latest):
                frames += 1
                at += size
            else:
                at += 1
    for k in range(count - at):
        text[k] = text[at + k]
    filled[0] = count - at
    return frames
