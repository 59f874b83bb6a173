"""Conversion between numbers and bytes: a table of fields, and two kernels that iterate over it.

A table has one row of `ROW` float64 per field; the kernels are independent of the device.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import floor, isfinite
from typing import Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.drivers.fields.options import COMMANDED, SENSED, TYPES, InputField, OutputField
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float32_at, float64_at, int64_at, uint8_at

ROW: Final = 9
"""Columns of a row.

offset, type, index of the value, scale, bias, raw value above which a button is pressed, minimum and maximum of the
value, True for big endian
"""
ROW_BYTES: Final = 8 * ROW

# Indices into sensed and commanded values.
COUNTS: Final = SENSED.index("a")
WRIST: Final = SENSED.index("d")
POSITION: Final = SENSED.index("x")
QUATERNION: Final = SENSED.index("qw")
GRIPPER: Final = SENSED.index("gripper")
BUTTONS: Final = SENSED.index("buttons")
SENSED_SIZE: Final = len(SENSED)
CURRENT: Final = COMMANDED.index("current_a")
FORCE: Final = COMMANDED.index("force_x")
TORQUE: Final = COMMANDED.index("torque_a")
PRESET: Final = COMMANDED.index("preset_a")
CONSTANT: Final = COMMANDED.index("constant")
COMMANDED_SIZE: Final = len(COMMANDED)

_INT8: Final = TYPES.index("int8")
_INT16: Final = TYPES.index("int16")
_INT32: Final = TYPES.index("int32")
_UINT8: Final = TYPES.index("uint8")
_UINT16: Final = TYPES.index("uint16")
_UINT32: Final = TYPES.index("uint32")
_FLOAT32: Final = TYPES.index("float32")


def input_table(fields: Iterable[InputField], big_endian: bool = False) -> Array:
    """Return rows (n, ROW) for fields from a device."""

    def default_to(value: float | None, none: float) -> float:
        return none if value is None else value

    rows = [
        (
            f.offset, TYPES.index(f.type), SENSED.index(f.meaning), f.scale, f.bias, default_to(f.button_above, np.inf),
            default_to(f.least, -np.inf), default_to(f.most, np.inf), big_endian,
        )
        for f in fields
    ]  # fmt: skip
    return np.array(rows, dtype=np.float64)


def output_table(fields: Iterable[OutputField], big_endian: bool = False) -> Array:
    """Return rows (n, ROW) for fields to a device."""
    rows = [
        (f.offset, TYPES.index(f.type), COMMANDED.index(f.meaning), f.scale, 0.0, 0.0, 0.0, 0.0, big_endian)
        for f in fields
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, ROW)


@jit
def decode(report: int, table: int, rows: int, scratch: int, values: Any) -> bool:
    """Decode a report into `values` (SENSED_SIZE,); return False if a value is not finite or out of range.

    report   address of its bytes without the id
    table    address of `rows` rows
    scratch  address of one int64

    Values of several button fields are added; a pressed button of `button_above` counts as 1.
    """
    raw_bytes, word, is_valid = uint8_at(report), int64_at(scratch), True
    values[BUTTONS] = 0.0
    for n in range(rows):
        row = float64_at(table + n * ROW_BYTES)
        at, kind, index = int(row[0]), int(row[1]), int(row[2])
        raw = _read_number(raw_bytes, word, scratch, at, kind, row[8] != 0.0)
        if raw > row[5]:
            raw -= 2.0 * row[5]
            values[BUTTONS] += 1.0
        value = row[3] * raw + row[4]
        is_valid = is_valid and isfinite(value) and row[6] <= value <= row[7]
        if index == BUTTONS:
            values[BUTTONS] += value
        else:
            values[index] = value
    return is_valid


@jit
def encode(values: Any, table: int, rows: int, scratch: int, report: int) -> bool:
    """Encode `values` (COMMANDED_SIZE,) into a report; return True if a value was clamped to the range of its field.

    report   address of its bytes without the id
    table    address of `rows` rows
    scratch  address of one int64
    """
    raw_bytes, word, is_clamped = uint8_at(report), int64_at(scratch), False
    for n in range(rows):
        row = float64_at(table + n * ROW_BYTES)
        at, kind = int(row[0]), int(row[1])
        raw = row[3] * values[int(row[2])]
        if kind == _FLOAT32:
            word[0] = 0
            float32_at(scratch)[0] = raw
            bits = word[0]
            size = 4
        else:
            low, high, size = _integer_range(kind)
            rounded = floor(raw + 0.5)
            clamped = min(max(rounded, low), high)
            is_clamped = is_clamped or clamped != rounded
            bits = int(clamped)
        for k in range(size):
            index = at + size - 1 - k if row[8] != 0.0 else at + k
            raw_bytes[index] = types.uint8((bits >> (8 * k)) & 255)
    return is_clamped


@jit
def _integer_range(kind: int) -> tuple[float, float, int]:
    if kind == _INT8:
        return -128.0, 127.0, 1
    if kind == _UINT8:
        return 0.0, 255.0, 1
    if kind == _INT16:
        return -32768.0, 32767.0, 2
    if kind == _UINT16:
        return 0.0, 65535.0, 2
    if kind == _INT32:
        return -2147483648.0, 2147483647.0, 4
    return 0.0, 4294967295.0, 4


@jit
def _read_number(raw_bytes: Any, word: Any, scratch: int, at: int, kind: int, big_endian: bool) -> float:
    size = 1
    if kind in (_INT16, _UINT16):
        size = 2
    elif kind not in (_INT8, _UINT8):
        size = 4
    bits = 0
    for k in range(size):
        index = at + size - 1 - k if big_endian else at + k
        bits |= int(raw_bytes[index]) << (8 * k)
    if kind == _FLOAT32:
        word[0] = bits
        return float(float32_at(scratch)[0])
    if kind in (_INT8, _INT16, _INT32):
        half = 1 << (8 * size - 1)
        if bits >= half:
            bits -= 2 * half
    return float(bits)


def encode_constants(
    fields: Iterable[OutputField], size: int, commanded: Mapping[int, float] | None = None, big_endian: bool = False
) -> NDArray[np.uint8]:
    """Return the bytes (size,) of a packet with its constants, the values `commanded` by index, and 0 elsewhere."""
    values, scratch, packet = np.zeros(COMMANDED_SIZE), np.zeros(1, np.int64), np.zeros(size, np.uint8)
    values[CONSTANT] = 1.0
    for index, value in (commanded or {}).items():
        values[index] = value
    rows = output_table(fields, big_endian)
    encode(values, rows.ctypes.data, len(rows), scratch.ctypes.data, packet.ctypes.data)
    return packet
