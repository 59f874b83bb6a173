"""Configuration of numbers in the bytes of a device: position, type and meaning of each."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Annotated, Final, Literal, get_args

import msgspec
from msgspec import Meta

from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Table, doc, is_usable, within

BYTES: Final = Range(1, 1024, "the longest packet of a USB interrupt endpoint")
FIELDS: Final = Range(1, 32, "more than any haptic device has")
USB_ID: Final = Range(0, 0xFFFF, "two bytes in the USB device descriptor")
SCALE: Final = Range(-1e9, 1e9, "beyond this a 32-bit field has no digits left")

Type = Literal["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32"]
TYPES: Final[tuple[str, ...]] = get_args(Type)
"""Types of a field; kernels use the index in this tuple."""
TYPE_BYTES: Final = {name: struct.calcsize(code) for name, code in zip(TYPES, "bBhHiIf", strict=True)}

Sensed = Literal["a", "b", "c", "d", "e", "f", "x", "y", "z", "qw", "qx", "qy", "qz", "gripper", "buttons"]
SENSED: Final[tuple[str, ...]] = get_args(Sensed)
"""Meanings of a field from a device: joints or encoders, position (m), orientation, bits of the button mask."""

Commanded = Literal[
    "current_a", "current_b", "current_c", "force_x", "force_y", "force_z",
    "torque_a", "torque_b", "torque_c", "preset_a", "preset_b", "preset_c", "constant",
]  # fmt: skip
COMMANDED: Final[tuple[str, ...]] = get_args(Commanded)
"""Meanings of a field to a device: currents (A), forces (N), torques (N m), counts to preset, or a constant `scale`."""


class InputField(Table, frozen=True, kw_only=True):
    """A number from the device: meaning = scale * raw + bias."""

    meaning: Annotated[Sensed, doc("quantity; several buttons are combined", "a")]
    offset: Annotated[int, Meta(ge=0, le=int(BYTES.high)), doc("first byte, from 0; a report id does not count", 0)]
    type: Annotated[Type, doc("type of the number", "int16")]
    scale: Annotated[float, within(SCALE, "per count, to m, rad or encoder counts", 1.0)] = 1.0
    bias: Annotated[float, within(SCALE, "added after scaling", 0.0)] = 0.0
    button_above: (
        Annotated[
            float,
            within(SCALE, "button 0 is pressed if the raw value is above this; twice this is then subtracted", 5000.0),
        ]
        | None
    ) = None
    least: (
        Annotated[float, within(SCALE, "smallest valid value after scaling; below it the sample is faulty", -3.2)]
        | None
    ) = None
    most: (
        Annotated[float, within(SCALE, "largest valid value after scaling; above it the sample is faulty", 3.2)] | None
    ) = None


class OutputField(Table, frozen=True, kw_only=True):
    """A number to the device: raw = scale * meaning, rounded to the nearest."""

    meaning: Annotated[Commanded, doc("quantity", "current_a")]
    offset: Annotated[int, Meta(ge=0, le=int(BYTES.high)), doc("first byte, from 0; a report id does not count", 0)]
    type: Annotated[Type, doc("type of the number", "int16")]
    scale: Annotated[float, within(SCALE, "counts per A, N or N m; value of a constant", 1000.0)] = 1.0


def check_layout(
    bytes_: int, fields: tuple[InputField | OutputField, ...], owner: str, note: str = ""
) -> Iterator[Complaint]:
    """Yield complaints about fields that exceed `bytes_` or overlap."""
    field_of_byte: dict[int, int] = {}
    for index, field in enumerate(fields):
        if not is_usable(field) or not is_usable(field.offset, field.type):
            continue
        end = field.offset + TYPE_BYTES[field.type]
        if end > bytes_:
            span = f"bytes {field.offset} to {end - 1}"
            fault = f"{span} exceed {owner} of {bytes_} bytes: offsets start at 0{note}"
            yield f"field[{index}].offset", field.offset, fault
        for byte in range(field.offset, min(end, bytes_)):
            first_index = field_of_byte.setdefault(byte, index)
            if first_index != index:
                fault = f"byte {byte} already belongs to field[{first_index}]: move one of them"
                yield f"field[{index}].offset", field.offset, fault
                break


def check_repeated_meanings(fields: tuple[InputField, ...]) -> Iterator[Complaint]:
    """Yield complaints about repeated meanings; `buttons` may be repeated, and are added."""
    meanings_seen = set()
    for index, field in enumerate(fields):
        if is_usable(field) and is_usable(field.meaning) and field.meaning != "buttons":
            if field.meaning in meanings_seen:
                yield f"field[{index}].meaning", field.meaning, "another field has the same meaning: remove one"
            meanings_seen.add(field.meaning)


def list_meanings(fields: Iterable[InputField | OutputField]) -> set[str] | None:
    """Return the meanings of fields; None if they are unknown."""
    if not is_usable(fields) or not is_usable(*fields):
        return None
    return {field.meaning for field in fields if is_usable(field.meaning)}


def check_missing_meanings(key: str, present: set[str], required: set[str], kind: str) -> Iterator[Complaint]:
    """Yield a complaint if the fields at `key` lack meanings that kinematics of this `kind` need."""
    missing = ", ".join(sorted(required - present))
    if missing:
        yield f"{key}.field", msgspec.UNSET, f"has no {missing}, required for {kind}: add a field for each"
