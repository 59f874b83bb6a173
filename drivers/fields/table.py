"""Conversion between numbers and bytes: a table of fields, and two kernels that iterate over it.

A table has one row of `ROW` float64 per field; the kernels are independent of the device.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import floor, inf, isfinite
from typing import Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.drivers.fields.options import COMMANDED, SENSED, TYPE_BYTES, TYPES, InputField, OutputField
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float32_at, float64_at, int64_at, uint8_at

ROW: Final = 11
"""Columns of a row.

offset, bytes, index of the value, scale, bias, raw value above which a button is pressed, minimum and maximum of the
value, True for big endian, minimum and maximum of the raw value: both infinite for a float
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

RAW_RANGES: Final[dict[str, tuple[float, float]]] = {
    name: (-inf, inf) if name == "float32" else (np.iinfo(name).min, np.iinfo(name).max) for name in TYPES
}


def make_input_table(fields: Iterable[InputField], big_endian: bool = False) -> Array:
    """Return rows (n, ROW) for fields from a device."""

    def default_to(value: float | None, none: float) -> float:
        return none if value is None else value

    rows = [
        (
            f.offset, TYPE_BYTES[f.type], SENSED.index(f.meaning), f.scale, f.bias, default_to(f.button_above, inf),
            default_to(f.least, -inf), default_to(f.most, inf), big_endian, *RAW_RANGES[f.type],
        )
        for f in fields
    ]  # fmt: skip
    return np.array(rows, dtype=np.float64)


def make_output_table(fields: Iterable[OutputField], big_endian: bool = False) -> Array:
    """Return rows (n, ROW) for fields to a device."""
    rows = [
        (
            f.offset, TYPE_BYTES[f.type], COMMANDED.index(f.meaning), f.scale, 0.0, 0.0, 0.0, 0.0, big_endian,
            *RAW_RANGES[f.type],
        )
        for f in fields
    ]  # fmt: skip
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
        index, raw = int(row[2]), _read_number(raw_bytes, word, scratch, row)
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
        at, size = int(row[0]), int(row[1])
        raw = row[3] * values[int(row[2])]
        if row[9] == -inf:
            word[0] = 0
            float32_at(scratch)[0] = raw
            bits = word[0]
        else:
            rounded = floor(raw + 0.5)
            clamped = min(max(rounded, row[9]), row[10])
            is_clamped = is_clamped or clamped != rounded
            bits = int(clamped)
        for k in range(size):
            index = at + size - 1 - k if row[8] != 0.0 else at + k
            raw_bytes[index] = types.uint8((bits >> (8 * k)) & 255)
    return is_clamped


@jit
def _read_number(raw_bytes: Any, word: Any, scratch: int, row: Any) -> float:
    at, size, bits = int(row[0]), int(row[1]), 0
    for k in range(size):
        index = at + size - 1 - k if row[8] != 0.0 else at + k
        bits |= int(raw_bytes[index]) << (8 * k)
    if row[9] == -inf:
        word[0] = bits
        return float(float32_at(scratch)[0])
    if bits > row[10]:  # a negative number
        bits -= 1 << (8 * size)
    return float(bits)


def encode_constants(
    fields: Iterable[OutputField], size: int, commanded: Mapping[int, float] | None = None, big_endian: bool = False
) -> NDArray[np.uint8]:
    """Return the bytes (size,) of a packet with its constants, the values `commanded` by index, and 0 elsewhere."""
    values, scratch, packet = np.zeros(COMMANDED_SIZE), np.zeros(1, np.int64), np.zeros(size, np.uint8)
    values[CONSTANT] = 1.0
    for index, value in (commanded or {}).items():
        values[index] = value
    rows = make_output_table(fields, big_endian)
    encode(values, rows.ctypes.data, len(rows), scratch.ctypes.data, packet.ctypes.data)
    return packet
