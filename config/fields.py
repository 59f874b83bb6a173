"""Building blocks of fields: numbers with range, unit, meaning and example.

The structs of `schema`, the commands of the wire and the options of drivers use them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from softfinger.config import limits

Complaint = tuple[str, Any, str]
"""Key within the struct, its value (UNSET: a whole table), and the fault."""


class Table(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Common options of all tables."""


class _TableTag:
    def __get__(self, table: object, table_type: type[Struct]) -> Any:
        return table_type.__struct_config__.tag or msgspec.UNSET


def make_tag_attribute() -> Any:
    """Return a class attribute with the tag of each table; UNSET for a class without a tag."""
    return _TableTag()


def is_usable(*values: object) -> bool:
    """Return whether all these fields were usable in the file."""
    return not any(value is msgspec.UNSET for value in values)


def is_complete(value: object) -> bool:
    """Return whether a value has no unusable part."""
    if isinstance(value, msgspec.Struct):
        return all(is_complete(getattr(value, name)) for name in value.__struct_fields__)
    if isinstance(value, Mapping):
        return all(map(is_complete, value.values()))
    return all(map(is_complete, value)) if isinstance(value, list | tuple) else is_usable(value)


def within(span: limits.Range, meaning: str, example: Any = None) -> Meta:
    """Return range, meaning and example of a number, for the structs here and the options of drivers."""
    examples = None if example is None else [example]
    return Meta(ge=span.low, le=span.high, description=meaning, examples=examples, extra={"reason": span.reason})


def sized(span: limits.Range, meaning: str, example: Any = None) -> Meta:
    """Return length, meaning and example of a text or a list."""
    examples = None if example is None else [example]
    return Meta(min_length=int(span.low), max_length=int(span.high), description=meaning, examples=examples)


def doc(meaning: str, example: Any = None) -> Meta:
    """Return meaning and example of a field that is not a single number."""
    return Meta(description=meaning, examples=None if example is None else [example])


said = doc
"""Earlier name of `doc`, used by drivers and shapes of other packages."""


_UNITS: Final = {
    "_kg_per_m3": "kg/m^3",
    "_rad_per_s": "rad/s",
    "_nm_per_a": "N m/A",
    "_nms_per_rad": "N m s/rad",
    "_nm_per_rad": "N m/rad",
    "_nm_per_s": "N m/s",
    "_ns_per_m": "N s/m",
    "_n_per_m": "N/m",
    "_n_per_s": "N/s",
    "_m_per_s": "m/s",
    "_s_per_m": "s/m",
    "_hz": "Hz",
    "_pa": "Pa",
    "_per_nm": "/(N m)",
    "_nm": "N m",
    "_rad": "rad",
    "_kg": "kg",
    "_deg": "deg",
    "_us": "us",
    "_ticks": "ticks",
    "_m": "m",
    "_n": "N",
    "_j": "J",
    "_s": "s",
    "_a": "A",
}


def find_unit(key: str) -> str:
    """Return the unit in the suffix of a key, longest suffix first; empty for a plain number or a text."""
    return next((name for suffix, name in _UNITS.items() if key.endswith(suffix)), "")


TopicPart = Annotated[
    str,
    Meta(
        min_length=int(limits.TOPIC_PART_LENGTH.low),
        max_length=int(limits.TOPIC_PART_LENGTH.high),
        pattern="^[A-Za-z0-9_-]+$",
        description="letters, digits, - and _; part of a telemetry topic",
        examples=["thumb"],
    ),
]
"""Name of a finger, or of its section of a rig."""
Coordinate = Annotated[float, Meta(ge=limits.COORDINATE_M.low, le=limits.COORDINATE_M.high)]
Length = Annotated[float, Meta(ge=limits.LENGTH_M.low, le=limits.LENGTH_M.high)]
Component = Annotated[float, Meta(ge=limits.QUATERNION.low, le=limits.QUATERNION.high)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Lengths = tuple[Length, Length, Length]
Vector = tuple[Component, Component, Component]
Orientation = tuple[Component, Component, Component, Component]

Resolved = Annotated[
    bool | None, doc("true, as in recordings and telemetry: all values are given here, and the library is not used")
]
"""Field of a table that may name an entry of a library; without it, a recording would change with the library."""


def normalise_orientation(table: Struct) -> None:
    """Normalise the quaternion `orientation_wxyz` of a new table, unless it is zero or not finite."""
    orientation = table.orientation_wxyz  # type: ignore[attr-defined]
    if not is_usable(orientation) or orientation is None:
        return
    norm = math.hypot(*orientation)
    # A quaternion that is unit to the last bits is not changed, so that a scene survives a round trip.
    if norm > 0.0 and math.isfinite(norm) and abs(norm - 1.0) > 1e-15:
        msgspec.structs.force_setattr(table, "orientation_wxyz", tuple(part / norm for part in orientation))


def check_orientation(orientation: tuple[float, float, float, float] | None) -> Iterator[Complaint]:
    """Yield a fault for a quaternion of all zeros at `orientation_wxyz`; a missing one is not a fault."""
    if is_usable(orientation) and orientation is not None and not any(orientation):
        yield "orientation_wxyz", orientation, "all zero is not an orientation: [1, 0, 0, 0] turns nothing"


def check_direction(key: str, direction: tuple[float, float, float] | None) -> Iterator[Complaint]:
    """Yield a fault for a direction of all zeros; a missing direction is not a fault."""
    if is_usable(direction) and direction is not None and not any(direction):
        yield key, direction, "all zero is not a direction: [0, 0, 1] is the z axis"
