"""What a rig may say of a HID device: which one, its reports byte by byte, its kinematics, its limits."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Coordinate, Table, known, said, sized, within
from softfinger.drivers.mounting import Mounting
from softfinger.drivers.system.descriptor import Announced

USB_ID: Final = Range(0, 0xFFFF, "two bytes in the USB device descriptor")
REPORT_ID: Final = Range(0, 255, "one byte; 0 where the device does not number its reports")
REPORT_BYTES: Final = Range(1, 1024, "the longest packet of a USB interrupt endpoint")
FIELDS: Final = Range(1, 32, "more than any haptic device has senses")
SCALE: Final = Range(-1e9, 1e9, "past this a 32-bit field has no digit left")
RATIO_M: Final = Range(1e-4, 1.0, "a capstan thinner than 0.1 mm is a wire, a wheel of 1 m stands on the floor")
LINK_M: Final = Range(1e-3, 2.0, "a desktop arm")
TORQUE_CONSTANT: Final = Range(1e-5, 100.0, "motors of desktop devices have 0.01 to 1 N m/A")
COUNTS: Final = Range(1, 1e7, "the finest encoders give some million counts a turn")
PRESET_COUNTS: Final = Range(-32768, 32767, "what a two-byte counter holds")
CURRENT_A: Final = Range(0.0, 20.0, "amplifiers of desktop devices end at a few amperes")
SILENCE_S: Final = Range(
    0.01, 0.2, "below, one kick has no time to work; above, force acts where the device was long ago"
)
GIVE_UP_S: Final = Range(
    0.01, 2.0, "below, one kick has no time to work; above, a device that is gone would go unnoticed"
)

Type = Literal["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32"]
TYPES: Final[tuple[str, ...]] = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32")
"""Types of a field, little-endian; a kernel knows each by its place here."""
TYPE_BYTES: Final = {name: struct.calcsize(code) for name, code in zip(TYPES, "bBhHiIf", strict=True)}

Sensed = Literal["a", "b", "c", "d", "e", "f", "x", "y", "z", "qw", "qx", "qy", "qz", "gripper", "buttons"]
SENSED: Final[tuple[str, ...]] = get_args(Sensed)
"""What a field of an input report may mean: encoder counts, position (m), orientation, bits of the button mask."""

Commanded = Literal[
    "current_a", "current_b", "current_c", "force_x", "force_y", "force_z",
    "preset_a", "preset_b", "preset_c", "constant",
]  # fmt: skip
COMMANDED: Final[tuple[str, ...]] = (
    "current_a", "current_b", "current_c", "force_x", "force_y", "force_z",
    "preset_a", "preset_b", "preset_c", "constant",
)  # fmt: skip
"""What a field of an output report may mean: currents (A), forces (N), counts to preset, or always its `scale`."""

Through = Literal["auto", "node", "thread"]
"""What carries the reports: the loop itself at a hidraw node; threads at hidapi; the first where there is a node."""

LIBRARY: Final = Path(__file__).with_name("reports.toml")

Lengths = tuple[
    Annotated[float, Meta(ge=RATIO_M.low, le=RATIO_M.high)],
    Annotated[float, Meta(ge=RATIO_M.low, le=RATIO_M.high)],
    Annotated[float, Meta(ge=RATIO_M.low, le=RATIO_M.high)],
]
Link = Annotated[float, Meta(ge=LINK_M.low, le=LINK_M.high)]
TorqueConstant = Annotated[float, Meta(ge=TORQUE_CONSTANT.low, le=TORQUE_CONSTANT.high)]
Preset = Annotated[float, Meta(ge=PRESET_COUNTS.low, le=PRESET_COUNTS.high)]
Counts = Annotated[float, Meta(ge=COUNTS.low, le=COUNTS.high)]


class InputField(Table, frozen=True, kw_only=True):
    """One number of an input report: meaning = scale * raw + bias."""

    meaning: Annotated[Sensed, said("what it is: encoder a to f, position, quaternion, gripper, buttons", "a")]
    offset: Annotated[int, Meta(ge=0, le=int(REPORT_BYTES.high)), said("first byte, after the report id", 0)]
    type: Annotated[Type, said("little-endian type", "int16")]
    scale: Annotated[float, within(SCALE, "per count; metres for x, y, z", 1.0)] = 1.0
    bias: Annotated[float, within(SCALE, "added after scaling", 0.0)] = 0.0
    button_above: (
        Annotated[float, within(SCALE, "a raw value above this has twice it added, for a pressed button 0", 5000.0)]
        | None
    ) = None


class OutputField(Table, frozen=True, kw_only=True):
    """One number of an output report: raw = scale * meaning, rounded to the nearest."""

    meaning: Annotated[Commanded, said("what it is: a current, a force, a preset count, a constant", "current_a")]
    offset: Annotated[int, Meta(ge=0, le=int(REPORT_BYTES.high)), said("first byte, after the report id", 0)]
    type: Annotated[Type, said("little-endian type", "int16")]
    scale: Annotated[float, within(SCALE, "counts per A or N; the value itself of a constant", 1000.0)] = 1.0


def _layout_faults(bytes_: int, fields: tuple[InputField | OutputField, ...]) -> Iterator[Complaint]:
    taken: dict[int, int] = {}
    for n, one in enumerate(fields):
        if not known(one) or not known(one.offset, one.type):
            continue
        end = one.offset + TYPE_BYTES[one.type]
        if end > bytes_:
            where = f"bytes {one.offset} to {end - 1}"
            yield f"field[{n}].offset", one.offset, f"{where} of a report of {bytes_}: count from 0, without the id"
        for byte in range(one.offset, min(end, bytes_)):
            other = taken.setdefault(byte, n)
            if other != n:
                yield f"field[{n}].offset", one.offset, f"byte {byte} belongs to field[{other}] already: move one"
                break


class InputReport(Table, frozen=True, kw_only=True):
    """What the device sends."""

    bytes: Annotated[int, within(REPORT_BYTES, "length without the report id, as in the descriptor", 8)]
    id: Annotated[int, within(REPORT_ID, "report id; 0: the device does not number its reports", 0)] = 0
    field: Annotated[tuple[InputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        if not known(self.bytes, self.field):
            return
        yield from _layout_faults(self.bytes, self.field)
        seen = set()
        for n, one in enumerate(self.field):
            if known(one) and known(one.meaning) and one.meaning != "buttons":
                if one.meaning in seen:
                    yield f"field[{n}].meaning", one.meaning, "another field has this meaning: leave one out"
                seen.add(one.meaning)


class OutputReport(Table, frozen=True, kw_only=True):
    """What the device is sent; bytes of no field are 0."""

    bytes: Annotated[int, within(REPORT_BYTES, "length without the report id, as in the descriptor", 8)]
    id: Annotated[int, within(REPORT_ID, "report id; 0: the device does not number its reports", 0)] = 0
    field: Annotated[tuple[OutputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        if known(self.bytes, self.field):
            yield from _layout_faults(self.bytes, self.field)


@lru_cache(maxsize=1)
def _library() -> Mapping[str, Mapping[str, Any]]:
    return msgspec.toml.decode(LIBRARY.read_bytes(), type=dict[str, dict[str, Any]])


def library_lengths() -> dict[str, Announced]:
    """Lengths of the reports of each format of the library."""
    return {
        name: Announced(*({one[way].get("id", 0): one[way]["bytes"]} for way in ("input", "output")))
        for name, one in _library().items()
    }


class Reports(Table, frozen=True, kw_only=True):
    """The wire format: one of the library by name, or every report described."""

    library: ClassVar[Any] = staticmethod(_library)
    """Formats that a rig may name; reports of the named one stand wherever the rig gives none itself."""

    name: Annotated[str, sized(limits.NAME_LENGTH, "a format of the library", "woodenhaptics-v2")] | None = None
    input: InputReport
    output: OutputReport
    preset: Annotated[OutputReport | None, said("report that sets the counts of encoders a, b, c")] = None

    def faults(self) -> Iterator[Complaint]:
        if not known(self.output, self.preset) or self.preset is None or not known(self.output.bytes, self.output.id):
            return
        if (self.preset.bytes, self.preset.id) != (self.output.bytes, self.output.id):
            theirs = f"{self.output.bytes} bytes with id {self.output.id}"
            yield "preset.bytes", self.preset.bytes, f"must be an output report like the other one: {theirs}"


class Cartesian(Table, frozen=True, kw_only=True, tag_field="kind", tag="cartesian"):
    """The device knows its position itself and is sent forces."""


class Chain(Table, frozen=True, kw_only=True, tag_field="kind", tag="chain"):
    """Three joints over capstans, and a wrist of three encoders where there is one; docs/devices/hid.md draws it."""

    capstan_m: Annotated[Lengths, said("diameters of the motors' capstans", [0.01, 0.01, 0.01])]
    body_m: Annotated[Lengths, said("diameters of the bodies they drive", [0.16, 0.12, 0.12])]
    link_m: Annotated[tuple[Link, Link, Link], said("lengths of bodies a, b, c", [0.08, 0.205, 0.245])]
    origin_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], said("workspace centre, from the foot of the arm", [0.22, 0.0, 0.08])
    ]
    counts_per_turn: Annotated[float, within(COUNTS, "counts per turn of a motor", 2000.0)]
    torque_constant_nm_per_a: Annotated[
        tuple[TorqueConstant, TorqueConstant, TorqueConstant], said("of the three motors", [0.321, 0.0603, 0.0603])
    ]
    aligned: Annotated[
        tuple[bool, bool, bool], said("motor and body turn the same way, so that counts fall", [False, False, False])
    ] = (False, False, False)
    calibration_counts: Annotated[
        tuple[Preset, Preset, Preset], said("what encoders a, b, c show in the calibration pose", [0, 0, 6000])
    ] = (0.0, 0.0, 0.0)
    current_max_a: Annotated[float, within(CURRENT_A, "most in one motor; all three come down together", 2.0)] = 2.0
    wrist_counts_per_turn: Annotated[float, within(COUNTS, "of encoders d, e, f; absent: no wrist", 1024.0)] | None = (
        None
    )
    wrist_aligned: Annotated[
        tuple[bool, bool, bool], said("whether joints D, E, F turn with their counts", [False, True, False])
    ] = (True, True, True)


class Options(Table, frozen=True, kw_only=True):
    """What a rig's [device] table may say for `driver = "hid"`."""

    vendor_id: Annotated[int, within(USB_ID, "USB vendor", 0x1234)]
    product_id: Annotated[int, within(USB_ID, "USB product", 0x0006)]
    serial: Annotated[str, said("serial number, where several are attached", "SN42")] | None = None
    path: Annotated[str, said("node, or hidapi's name on USB, in place of looking", "/dev/hidraw0")] | None = None
    through: Annotated[Through, said("the loop at the node, threads at hidapi, or what there is", "auto")] = "auto"
    reports: Reports
    kinematics: Chain | Cartesian
    mounting: Mounting = Mounting()
    calibrate: Annotated[bool, said("the arm rests in its calibration pose when opened: set its counts", False)] = False
    force_max_n: Annotated[float, within(limits.FORCE_MAX_N, "most that it displays", 5.0)]
    stiffness_max_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "most that it renders stably", 1000.0)]
    damping_max_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "the same of damping", 8.0)]
    workspace_radius_m: Annotated[float, Meta(gt=0.0, le=1.0), said("about the workspace centre", 0.1)]
    kick_s: Annotated[float, within(SILENCE_S, "after so long without a report a zero is sent", 0.01)] = 0.01
    timeout_s: Annotated[float, within(GIVE_UP_S, "after so long without a report the device is given up", 0.1)] = 0.1

    def faults(self) -> Iterator[Complaint]:
        if known(self.kick_s, self.timeout_s) and self.timeout_s < self.kick_s:
            yield "timeout_s", self.timeout_s, f"must be at least kick_s = {self.kick_s:g}, so that a kick can help"
        if known(self.path, self.through) and self.through == "node" and not (self.path or "/").startswith("/"):
            yield "path", self.path, 'is hidapi\'s name on USB, and through = "node" needs a node such as /dev/hidraw0'
        if not known(self.reports, self.kinematics):
            return
        reports, chain = self.reports, isinstance(self.kinematics, Chain)
        if not known(reports.input, reports.output, reports.preset):
            return
        sensed = _meanings(reports.input)
        commanded = _meanings(reports.output)
        if sensed is None or commanded is None:
            return
        kind = "chain" if chain else "cartesian"
        yield from _needed("reports.input", sensed, {*"abc"} if chain else {*"xyz"}, kind)
        needed = {f"current_{k}" for k in "abc"} if chain else {f"force_{k}" for k in "xyz"}
        yield from _needed("reports.output", commanded, needed, kind)
        wrist = self.kinematics.wrist_counts_per_turn if isinstance(self.kinematics, Chain) else None
        if wrist is not None and known(wrist):
            yield from _needed("reports.input", sensed, {*"def"}, "chain with a wrist")
        quaternion = {"qw", "qx", "qy", "qz"}
        if sensed & quaternion and (chain or not quaternion <= sensed):
            yield (
                "reports.input.field",
                sorted(sensed & quaternion),
                "a cartesian device senses all of qw to qz or none",
            )
        if self.calibrate is True and not chain:
            yield "calibrate", True, "only a chain has a calibration pose: leave it false"


def _meanings(report: InputReport | OutputReport) -> set[str] | None:
    if not known(report.field) or not known(*report.field):
        return None
    return {one.meaning for one in report.field if known(one.meaning)}


def _needed(key: str, has: set[str], needs: set[str], kind: str) -> Iterator[Complaint]:
    lacking = ", ".join(sorted(needs - has))
    if lacking:
        yield f"{key}.field", msgspec.UNSET, f"lacks {lacking}, which a {kind} needs: add a field for each"
