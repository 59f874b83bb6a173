"""The record: what one servo tick leaves behind, as a table.

A record is one row of float64. The servo writes it, the ring carries it, telemetry names it,
results files flatten it, and docs/protocol.md lists it; all of them read this table, so a field
is added here and nowhere else. Integers are exact in float64 up to 2**53.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Kind = Literal["float", "int"]

POSITION_MAX_M: Final = 1e6
"""A coordinate beyond this is a broken sensor; its square is still far from overflow."""

FREE: Final = 0
ROLLING: Final = 1
SLIDING: Final = 2
MODE_NAMES: Final = ("free", "rolling", "sliding")

CAUSE_NAMES: Final = ("none", "touch", "drag", "theta_max", "stop", "reverse", "release")
CAUSE_NONE: Final = 0
CAUSE_TOUCH: Final = 1
CAUSE_DRAG: Final = 2
CAUSE_THETA_MAX: Final = 3
CAUSE_STOP: Final = 4
CAUSE_REVERSE: Final = 5
CAUSE_RELEASE: Final = 6


@dataclass(frozen=True)
class Field:
    """One field of a record: dotted telemetry name, number of components, kind, unit, frame, meaning."""

    name: str
    size: int
    kind: Kind
    unit: str
    frame: str
    meaning: str


FIELDS: Final = (
    Field("timestamp", 1, "float", "s", "", "time of the tick since the epoch"),
    Field("tick", 1, "int", "1", "", "ticks since the servo started"),
    Field("dt", 1, "float", "s", "", "time step the contact step used"),
    Field("probe.position", 3, "float", "m", "world", "measured fingertip centre"),
    Field("probe.orientation", 4, "float", "1", "fingertip to world", "unit quaternion w, x, y, z"),
    Field("probe.velocity", 3, "float", "m/s", "world", "filtered probe velocity"),
    Field("proxy.position", 3, "float", "m", "world", "fingertip centre kept outside all objects"),
    Field("contact.mode", 1, "int", "1", "", "0 free, 1 rolling, 2 sliding"),
    Field("contact.object", 1, "int", "1", "", "index of the touched object in the scene, -1 none"),
    Field("contact.penetration", 1, "float", "m", "", "depth of the probe behind the proxy along the normal"),
    Field("contact.point", 3, "float", "m", "world", "contact point on the object"),
    Field("contact.normal", 3, "float", "1", "world", "outward unit normal of the object at the contact point"),
    Field("contact.finger_point", 3, "float", "m", "fingertip", "contact point on the fingertip"),
    Field("contact.rolled", 1, "float", "rad", "", "roll angle accumulated since touch"),
    Field("contact.spin", 1, "float", "rad", "", "torsional wind-up about the normal"),
    Field("force", 3, "float", "N", "world", "force on the hand as commanded, after the guard"),
    Field("torque", 3, "float", "N m", "world", "torque on the hand about the fingertip centre, after the guard"),
    Field("servo.late", 1, "float", "s", "", "wake-up after the deadline"),
    Field("servo.exec", 1, "float", "s", "", "time from wake-up until the device write returned"),
    Field("servo.missed", 1, "int", "1", "", "deadlines missed since the servo started"),
    Field("buttons", 1, "int", "bits", "", "device buttons, bit 0 the first"),
    Field("contact.cause", 1, "int", "1", "", "cause of this tick's mode change, 0 none"),
    Field("contact.normal_force", 1, "float", "N", "", "normal force before the guard"),
    Field("contact.tangential_force", 1, "float", "N", "", "magnitude of the tangential force before the guard"),
    Field("servo.guard", 1, "int", "bits", "", "what the guard changed in this tick"),
    Field("servo.busy", 1, "float", "s", "", "the previous tick from wake-up until it slept again"),
    Field("passivity.energy", 1, "float", "J", "", "work taken from the hand in this contact, less than 0 if owed"),
    Field("passivity.damping", 1, "float", "N s/m", "", "damping added because of what is owed"),
    Field("servo.device", 1, "int", "1", "", "status of this tick's device read and write"),
    Field("gripper", 1, "float", "rad", "", "opening of the device's gripper, 0 without one"),
)


def _offsets() -> dict[str, int]:
    offsets, at = {}, 0
    for field in FIELDS:
        offsets[field.name] = at
        at += field.size
    return offsets


OFFSET: Final = _offsets()
"""First column of each field, by dotted name."""

RECORD_SIZE: Final = sum(field.size for field in FIELDS)
"""Columns of one record."""


def columns() -> list[str]:
    """Names of the record's columns, components as `name[i]`, in order; the header of a results file."""
    return [f"{f.name}[{i}]" if f.size > 1 else f.name for f in FIELDS for i in range(f.size)]
