"""Table of the record: the result of one servo tick.

A record is one row of float64. The servo, the ring buffer, telemetry, results files and docs/reference/ all read this
table, so a field is added only here, at the end. Integers are exact in float64 up to 2**53.
"""

from dataclasses import dataclass
from enum import IntEnum
from itertools import accumulate
from typing import Annotated, Final, Literal, NamedTuple, get_type_hints

Kind = Literal["float", "int"]

POSITION_MAX_M: Final = 1e6
"""Largest plausible coordinate: beyond it a sensor is broken. Its square is still far from overflow."""

PATCHES: Final = 3
"""Number of contact patches in a record, `contacts0` the most loaded; a message has them in a list."""

FREE: Final = 0
ROLLING: Final = 1
SLIDING: Final = 2


class ContactMode(IntEnum):
    """Mode of a contact: `contact.mode` of records and messages, as the same number."""

    FREE = FREE
    ROLLING = ROLLING
    SLIDING = SLIDING


MODE_NAMES: Final = ("free", "rolling", "sliding")

CAUSE_NAMES: Final = ("none", "touch", "drag", "theta_max", "stop", "reverse", "release", "restart")
CAUSE_NONE: Final = 0
CAUSE_TOUCH: Final = 1
CAUSE_DRAG: Final = 2
CAUSE_THETA_MAX: Final = 3
CAUSE_STOP: Final = 4
CAUSE_REVERSE: Final = 5
CAUSE_RELEASE: Final = 6
CAUSE_RESTART: Final = 7

LARGE_DISPLACEMENT: Final = 1
LARGE_ROTATION: Final = 2
LARGE_STRAIN: Final = 4
UNSOLVED: Final = 8
"""Bits of `contact.nonlinear`."""

UNSEARCHED: Final = 1
ON_ITS_WAY: Final = 2
"""Values of `contact.budget`, besides 0."""


class Offsets(NamedTuple):
    """Table of the record: each field with its number of components, kind, unit, frame and meaning.

    Its telemetry name has a dot in place of the first underscore.
    """

    timestamp: Annotated[int, 1, "float", "s", "", "time of the tick since the epoch"]
    tick: Annotated[int, 1, "int", "1", "", "ticks since the servo started"]
    dt: Annotated[int, 1, "float", "s", "", "time step of the contact step"]
    probe_position: Annotated[int, 3, "float", "m", "world", "measured fingertip centre"]
    probe_orientation: Annotated[int, 4, "float", "1", "fingertip to world", "unit quaternion w, x, y, z"]
    probe_velocity: Annotated[int, 3, "float", "m/s", "world", "filtered probe velocity"]
    proxy_position: Annotated[int, 3, "float", "m", "world", "centre of the fingertip as rendered, outside all objects"]
    contact_mode: Annotated[int, 1, "int", "1", "", "0 free, 1 rolling, 2 sliding"]
    contact_object: Annotated[int, 1, "int", "1", "", "index of the touched object in the scene, -1 none"]
    contact_penetration: Annotated[int, 1, "float", "m", "", "depth of the probe below the proxy along the normal"]
    contact_point: Annotated[int, 3, "float", "m", "world", "contact point on the object"]
    contact_normal: Annotated[int, 3, "float", "1", "world", "outward unit normal of the object at the contact point"]
    contact_finger_point: Annotated[int, 3, "float", "m", "fingertip", "contact point on the fingertip"]
    contact_rolled: Annotated[int, 1, "float", "rad", "", "roll angle accumulated since touch"]
    contact_spin: Annotated[int, 1, "float", "rad", "", "torsional wind-up about the normal"]
    force: Annotated[int, 3, "float", "N", "world", "force on the hand as commanded, after the guard"]
    torque: Annotated[int, 3, "float", "N m", "world", "torque on the hand about the fingertip centre, after the guard"]
    servo_late: Annotated[int, 1, "float", "s", "", "wake-up after the deadline"]
    servo_exec: Annotated[int, 1, "float", "s", "", "time from wake-up until the device write returned"]
    servo_missed: Annotated[int, 1, "int", "1", "", "deadlines missed since the servo started"]
    buttons: Annotated[int, 1, "int", "bits", "", "device buttons, bit 0 the first"]
    contact_cause: Annotated[int, 1, "int", "1", "", "cause of the mode change in this tick, 0 none"]
    contact_normal_force: Annotated[int, 1, "float", "N", "", "normal force before the guard"]
    contact_tangential_force: Annotated[int, 1, "float", "N", "", "magnitude of the tangential force before the guard"]
    servo_guard: Annotated[int, 1, "int", "bits", "", "changes by the guard in this tick"]
    servo_busy: Annotated[int, 1, "float", "s", "", "duration of the previous tick, from wake-up to sleep"]
    passivity_energy: Annotated[
        int, 1, "float", "J", "", "work of the hand in this contact; below 0: energy that the rendering generated"
    ]
    passivity_damping: Annotated[int, 1, "float", "N s/m", "", "damping added by the passivity controller"]
    servo_device: Annotated[int, 1, "int", "1", "", "status of this tick's device read and write"]
    gripper: Annotated[int, 1, "float", "rad", "", "opening of the device's gripper, 0 without one"]
    contacts0_object: Annotated[int, 1, "int", "1", "", "index of its object in the scene, -1 none"]
    contacts0_point: Annotated[int, 3, "float", "m", "world", "contact point on the object"]
    contacts0_normal: Annotated[int, 3, "float", "1", "world", "outward unit normal of the object at that point"]
    contacts0_force: Annotated[int, 3, "float", "N", "world", "force on the hand, before the guard"]
    contacts0_mode: Annotated[int, 1, "int", "1", "", "mode: 0 free, 1 rolling, 2 sliding"]
    contacts0_spin: Annotated[int, 1, "float", "rad", "", "torsional wind-up about the normal"]
    contacts1_object: Annotated[int, 1, "int", "1", "", "index of its object in the scene, -1 none"]
    contacts1_point: Annotated[int, 3, "float", "m", "world", "contact point on the object"]
    contacts1_normal: Annotated[int, 3, "float", "1", "world", "outward unit normal of the object at that point"]
    contacts1_force: Annotated[int, 3, "float", "N", "world", "force on the hand, before the guard"]
    contacts1_mode: Annotated[int, 1, "int", "1", "", "mode: 0 free, 1 rolling, 2 sliding"]
    contacts1_spin: Annotated[int, 1, "float", "rad", "", "torsional wind-up about the normal"]
    contacts2_object: Annotated[int, 1, "int", "1", "", "index of its object in the scene, -1 none"]
    contacts2_point: Annotated[int, 3, "float", "m", "world", "contact point on the object"]
    contacts2_normal: Annotated[int, 3, "float", "1", "world", "outward unit normal of the object at that point"]
    contacts2_force: Annotated[int, 3, "float", "N", "world", "force on the hand, before the guard"]
    contacts2_mode: Annotated[int, 1, "int", "1", "", "mode: 0 free, 1 rolling, 2 sliding"]
    contacts2_spin: Annotated[int, 1, "float", "rad", "", "torsional wind-up about the normal"]
    contact_torsion: Annotated[int, 1, "float", "N m", "", "moment on the hand about the normal, before the guard"]
    contact_patch_radius: Annotated[int, 1, "float", "m", "", "radius of the patch, 0 without [fingertip.patch]"]
    contact_patch_normal: Annotated[int, 3, "float", "1", "fingertip", "normal of the object at the patch"]
    contact_patch_stretch: Annotated[
        int, 3, "float", "m", "fingertip", "displacement of the skin relative to the fingertip, along the surface"
    ]
    contact_budget: Annotated[
        int,
        1,
        "int",
        "1",
        "",
        (
            "1 if the search of a mesh or height map did not finish: the proxy did not move, or a first touch or gap "
            "is unknown; 2 if the proxy is not yet at rest: then the force is not the sum of `contacts`"
        ),
    ]
    limits_speed: Annotated[int, 1, "float", "m/s", "", "smoothed speed of the handle; 0 without that limit"]
    limits_heat: Annotated[int, 1, "float", "1", "", "heat of the motors; 1 is that of the continuous force"]
    limits_energy: Annotated[
        int, 1, "float", "J", "", "energy that contacts transferred to the hand, reduced over time"
    ]
    contact_displacement: Annotated[int, 3, "float", "m", "world", "displacement of an elastic surface at the contact"]
    contact_nonlinear: Annotated[
        int,
        1,
        "int",
        "bits",
        "",
        (
            "limits of linear elasticity that are exceeded: 1 displacement above 10 % of the object's size, 2 rotation "
            "above 10 degrees, 4 strain above 10 %; 8 displacement not solved to 1 um in this tick"
        ),
    ]


@dataclass(frozen=True)
class Field:
    """One field of a record: dotted telemetry name, number of components, kind, unit, frame, meaning."""

    name: str
    size: int
    kind: Kind
    unit: str
    frame: str
    meaning: str

    @property
    def at(self) -> int:
        """First column of the field in a record."""
        return FIRST_COLUMNS[self.name]


FIELDS: Final = tuple(
    Field(name.replace("_", ".", 1), *declared.__metadata__)
    for name, declared in get_type_hints(Offsets, include_extras=True).items()
)

AT: Final = Offsets(*accumulate((field.size for field in FIELDS[:-1]), initial=0))
"""First column of each field by name, also for kernels: `row[AT.contact_mode]`."""

FIRST_COLUMNS: Final = {field.name: at for field, at in zip(FIELDS, AT, strict=True)}
"""First column of each field by telemetry name."""

NAMED: Final = {field.name: field for field in FIELDS}
"""Fields by telemetry name, to look up names from users."""

RECORD_SIZE: Final = sum(field.size for field in FIELDS)
"""Number of columns of a record."""


def list_columns() -> list[str]:
    """Return the names of the record's columns in order, components as `name[i]`; the header of a results file."""
    return [f"{f.name}[{i}]" if f.size > 1 else f.name for f in FIELDS for i in range(f.size)]
