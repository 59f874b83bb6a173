"""Configuration of the mechanism between a device's joints and its end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Final

from msgspec import Meta

from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Point, Table, doc, is_usable, within
from softfinger.drivers.fields.options import InputField, OutputField, check_missing_meanings, list_meanings

DIAMETER_M: Final = Range(1e-4, 1.0, "from the thinnest capstan to a wheel of 1 m")
LINK_M: Final = Range(1e-3, 2.0, "a desktop arm")
SPACING_M: Final = Range(0.0, 2.0, "0: both motors on one axis; a desktop device")
TORQUE_CONSTANT: Final = Range(1e-5, 100.0, "motors of desktop devices have 0.01 to 1 N m/A")
COUNTS: Final = Range(1, 1e7, "the finest encoders have some million counts per turn")
PRESET_COUNTS: Final = Range(-32768, 32767, "range of a two-byte counter")
CURRENT_A: Final = Range(0.0, 20.0, "amplifiers of desktop devices have at most a few amperes")
TORQUE_NM: Final = Range(0.0, 20.0, "a joint of a desktop device; 40 N at half a metre")
ANGLE_DEG: Final = Range(-360.0, 360.0, "one full turn")

Diameter = Annotated[float, Meta(ge=DIAMETER_M.low, le=DIAMETER_M.high)]
Diameters = tuple[Diameter, Diameter, Diameter]
Link = Annotated[float, Meta(ge=LINK_M.low, le=LINK_M.high)]
TorqueConstant = Annotated[float, Meta(ge=TORQUE_CONSTANT.low, le=TORQUE_CONSTANT.high)]
Preset = Annotated[float, Meta(ge=PRESET_COUNTS.low, le=PRESET_COUNTS.high)]
Counts = Annotated[float, Meta(ge=COUNTS.low, le=COUNTS.high)]
Angle = Annotated[float, Meta(ge=ANGLE_DEG.low, le=ANGLE_DEG.high)]


class Cartesian(Table, frozen=True, kw_only=True, tag_field="kind", tag="cartesian"):
    """The device sends its position and takes forces."""

    sensed: ClassVar[frozenset[str]] = frozenset("xyz")
    commanded: ClassVar[frozenset[str]] = frozenset({"force_x", "force_y", "force_z"})
    dof: ClassVar[int] = 3


class Chain(Table, frozen=True, kw_only=True, tag_field="kind", tag="chain"):
    """Three joints over capstans, with or without a wrist of three encoders."""

    sensed: ClassVar[frozenset[str]] = frozenset("abc")
    commanded: ClassVar[frozenset[str]] = frozenset({"current_a", "current_b", "current_c"})
    dof: ClassVar[int] = 3

    capstan_m: Annotated[Diameters, doc("diameters of the motors' capstans", [0.01, 0.01, 0.01])]
    body_m: Annotated[Diameters, doc("diameters of the bodies that they drive", [0.16, 0.12, 0.12])]
    link_m: Annotated[tuple[Link, Link, Link], doc("lengths of bodies a, b, c", [0.08, 0.205, 0.245])]
    origin_m: Annotated[Point, doc("workspace centre, from the foot of the arm", [0.22, 0.0, 0.08])]
    counts_per_turn: Annotated[float, within(COUNTS, "counts per turn of a motor", 2000.0)]
    torque_constant_nm_per_a: Annotated[
        tuple[TorqueConstant, TorqueConstant, TorqueConstant], doc("motors a, b, c", [0.321, 0.0603, 0.0603])
    ]
    aligned: Annotated[
        tuple[bool, bool, bool],
        doc("motor and body turn in the same direction, so that counts decrease", [False, False, False]),
    ] = (False, False, False)
    calibration_counts: Annotated[
        tuple[Preset, Preset, Preset], doc("counts a, b, c in the calibration pose", [0, 0, 6000])
    ] = (0.0, 0.0, 0.0)
    current_max_a: Annotated[
        float, within(CURRENT_A, "largest current of a motor; all are scaled down together", 2.0)
    ] = 2.0
    wrist_counts_per_turn: (
        Annotated[float, within(COUNTS, "counts of encoders d, e, f; default: no wrist", 1024.0)] | None
    ) = None
    wrist_aligned: Annotated[
        tuple[bool, bool, bool],
        doc("whether joints D, E, F turn in the direction of their counts", [False, True, False]),
    ] = (True, True, True)


class Paddle(Table, frozen=True, kw_only=True, tag_field="kind", tag="paddle"):
    """One joint with a handle on it, such as a Hapkit."""

    sensed: ClassVar[frozenset[str]] = frozenset("a")
    commanded: ClassVar[frozenset[str]] = frozenset({"torque_a"})
    dof: ClassVar[int] = 1

    length_m: Annotated[float, within(LINK_M, "distance from the joint's axis to the end of the handle", 0.07)]
    torque_max_nm: Annotated[float, within(TORQUE_NM, "largest torque of the joint", 0.3)]


class Pantograph(Table, frozen=True, kw_only=True, tag_field="kind", tag="pantograph"):
    """Two motors and a loop of four links in a plane, such as a Haply 2DIY."""

    sensed: ClassVar[frozenset[str]] = frozenset("ab")
    commanded: ClassVar[frozenset[str]] = frozenset({"torque_a", "torque_b"})
    dof: ClassVar[int] = 2

    base_m: Annotated[float, within(SPACING_M, "between the motors' axes", 0.038)]
    inner_m: Annotated[float, within(LINK_M, "links at the motors", 0.07)]
    outer_m: Annotated[float, within(LINK_M, "links at the end", 0.09)]
    origin_m: Annotated[Point, doc("workspace centre, from the axis of motor a", [0.019, 0.1, 0.0])] = (0.0, 0.0, 0.0)
    torque_max_nm: Annotated[float, within(TORQUE_NM, "largest torque of a joint; all are scaled down together", 0.12)]


class Delta(Table, frozen=True, kw_only=True, tag_field="kind", tag="delta"):
    """Three legs with motors in the base, and an end that does not rotate."""

    sensed: ClassVar[frozenset[str]] = frozenset("abc")
    commanded: ClassVar[frozenset[str]] = frozenset({"torque_a", "torque_b", "torque_c"})
    dof: ClassVar[int] = 3

    base_m: Annotated[float, within(SPACING_M, "from the centre to a motor's axis", 0.06)]
    end_m: Annotated[float, within(SPACING_M, "from the end's centre to its joints", 0.03)]
    arm_m: Annotated[float, within(LINK_M, "arm at the motor", 0.08)]
    rod_m: Annotated[float, within(LINK_M, "parallelogram from arm to end", 0.17)]
    legs_deg: Annotated[tuple[Angle, Angle, Angle], doc("angles of legs a, b, c about z", [0.0, 120.0, 240.0])] = (
        0.0,
        120.0,
        240.0,
    )
    origin_m: Annotated[Point, doc("workspace centre, from the base's centre", [0.0, 0.0, 0.2])] = (0.0, 0.0, 0.0)
    torque_max_nm: Annotated[float, within(TORQUE_NM, "largest torque of a joint; all are scaled down together", 0.2)]

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.base_m, self.end_m, self.arm_m, self.rod_m):
            return
        gap = abs(self.base_m - self.end_m + 0.5 * self.arm_m)
        if self.rod_m <= gap:
            yield "rod_m", self.rod_m, f"must be above {gap:g} m, so that the legs meet with arms at 60 degrees"


Kinematics = Cartesian | Chain | Paddle | Pantograph | Delta

QUATERNION: Final = frozenset({"qw", "qx", "qy", "qz"})


def check_fields(
    key: str, input_fields: tuple[InputField, ...], output_fields: tuple[OutputField, ...], kinematics: Kinematics
) -> Iterator[Complaint]:
    """Yield complaints about fields at `key` that the kinematics lacks or cannot use."""
    sensed, commanded = list_meanings(input_fields), list_meanings(output_fields)
    if sensed is None or commanded is None:
        return
    kind = str(kinematics.__struct_config__.tag)
    yield from check_missing_meanings(f"{key}.input", sensed, set(kinematics.sensed), kind)
    yield from check_missing_meanings(f"{key}.output", commanded, set(kinematics.commanded), kind)
    if isinstance(kinematics, Chain) and kinematics.wrist_counts_per_turn is not None:
        yield from check_missing_meanings(f"{key}.input", sensed, {*"def"}, "chain with a wrist")
    sensed_quaternion = sorted(sensed & QUATERNION)
    if sensed_quaternion and (not isinstance(kinematics, Cartesian) or len(sensed_quaternion) < len(QUATERNION)):
        yield f"{key}.input.field", sensed_quaternion, "a cartesian device measures all of qw to qz or none"
