"""What a rig may say of a device on a serial port: which one, its frames, its mechanism, limits and silences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Table, known, said, sized, within
from softfinger.drivers.fields.options import (
    FIELDS,
    TYPE_BYTES,
    InputField,
    OutputField,
    layout_faults,
    repeated_meanings,
)
from softfinger.drivers.kinematics.options import Kinematics, faults_of_fields
from softfinger.drivers.mounting import Mounting

USB_ID: Final = Range(0, 0xFFFF, "two bytes in the USB device descriptor")
FORCE_MAX_N: Final = Range(0.0, 32.0, "a frame gives mN as a number of two bytes, which ends at 32.767 N")
SILENCE_S: Final = Range(
    0.005, 0.2, "below, a late answer is a silence; above, force acts where the device was long ago"
)
GIVE_UP_S: Final = Range(
    0.005, 2.0, "below, a late answer is a silence; above, a device that is gone would go unnoticed"
)
WAKE_S: Final = Range(0.2, 60.0, "below, one kick has no time to work; nobody waits longer than a minute")

FRAME_BYTES: Final = Range(1, 256, "at 115200 Bd a frame of 256 bytes takes 22 ms")
MARKS: Final = Range(0, 8, "more than anybody sends to mark a frame")
RESYNC: Final = Range(1, 256, "the longest frame")

Order = Literal["little", "big"]
Mode = Literal["answer", "stream"]
Check = Literal["sum8", "xor8", "crc8", "crc16-ccitt", "crc16-modbus"]
CHECKS: Final[tuple[str, ...]] = ("sum8", "xor8", "crc8", "crc16-ccitt", "crc16-modbus")
"""Kinds of checksum; a kernel knows each by its place here."""
CHECK_BYTES: Final = {name: 2 if name.startswith("crc16") else 1 for name in CHECKS}
Baud = Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 921600, 1000000, 2000000]
Byte = Annotated[int, Meta(ge=0, le=255)]


class Checksum(Table, frozen=True, kw_only=True):
    """One or two bytes that tell a damaged frame."""

    kind: Annotated[Check, said("how it is computed", "crc8")]
    offset: Annotated[int, Meta(ge=1, le=int(FRAME_BYTES.high)), said("where it is; it covers the bytes before", 6)]
    first: Annotated[int, Meta(ge=0, le=int(FRAME_BYTES.high)), said("first byte that it covers", 0)] = 0


class Frame(Table, frozen=True, kw_only=True):
    """What frames in both directions have."""

    bytes: Annotated[int, within(FRAME_BYTES, "length of a frame, marks and checksum included", 8)]
    start: Annotated[tuple[Byte, ...], sized(MARKS, "bytes that every frame begins with", [165])] = ()
    end: Annotated[tuple[Byte, ...], sized(MARKS, "bytes that every frame ends with", [10])] = ()
    check: Checksum | None = None

    def marked(self) -> bool:
        """Whether a frame can be told in a stream of bytes."""
        return self.check is not None or bool(self.start and self.end)

    def taken(self) -> Iterator[tuple[int, str]]:
        """Bytes that are no field's, and whose they are."""
        yield from ((k, "start") for k in range(len(self.start)))
        yield from ((k, "end") for k in range(self.bytes - len(self.end), self.bytes))
        if self.check is not None:
            yield from ((self.check.offset + k, "check") for k in range(CHECK_BYTES[self.check.kind]))


def frame_faults(frame: Frame, fields: tuple[InputField | OutputField, ...]) -> Iterator[Complaint]:
    """Complaints about marks, a checksum and fields that reach past a frame or into each other."""
    if not known(frame.bytes, frame.start, frame.end, frame.check, fields) or not known(*fields):
        return
    yield from layout_faults(frame.bytes, fields, "a frame")
    if frame.check is not None:
        if not known(frame.check.kind, frame.check.offset, frame.check.first):
            return
        if frame.check.first >= frame.check.offset:
            yield "check.first", frame.check.first, f"must be below offset = {frame.check.offset}: it covers nothing"
    whose = dict[int, str]()
    for byte, name in frame.taken():
        if not 0 <= byte < frame.bytes or byte in whose:
            yield name, byte, f"byte {byte} is {whose.get(byte, f'beyond a frame of {frame.bytes}')}: make room for it"
            return
        whose[byte] = name
    for n, one in enumerate(fields):
        if known(one.offset, one.type):
            for byte in range(one.offset, one.offset + TYPE_BYTES[one.type]):
                if byte in whose:
                    yield f"field[{n}].offset", one.offset, f"byte {byte} belongs to {whose[byte]}: move one"
                    break


class InputFrame(Frame, frozen=True, kw_only=True):
    """What the board sends."""

    field: Annotated[tuple[InputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        yield from frame_faults(self, self.field)
        if known(self.field):
            yield from repeated_meanings(self.field)


class OutputFrame(Frame, frozen=True, kw_only=True):
    """What the board is sent; bytes of no field are 0."""

    field: Annotated[tuple[OutputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        yield from frame_faults(self, self.field)


class Resync(Table, frozen=True, kw_only=True):
    """Bytes that end a frame of which the board still awaits a part, and that mean nothing to it otherwise."""

    byte: Annotated[Byte, said("such a byte", 3)]
    count: Annotated[int, within(RESYNC, "so many, as many as a frame has", 9)]


class Frames(Table, frozen=True, kw_only=True):
    """The language of a board."""

    mode: Annotated[Mode, said("whether it answers each frame, or sends by itself", "answer")]
    order: Annotated[Order, said("which byte of a number comes first, the lowest or the highest", "little")] = "little"
    input: InputFrame
    output: OutputFrame
    setup: Annotated[OutputFrame | None, said("sent once when the port is opened; its fields are constants")] = None
    resync: Resync | None = None

    def faults(self) -> Iterator[Complaint]:
        if known(self.mode, self.input) and self.mode == "stream":
            marks = (self.input.start, self.input.end, self.input.check)
            if known(*marks) and not self.input.marked():
                yield "input", msgspec.UNSET, "a stream needs a check, or both start and end: its frames are not told"
        if known(self.setup) and self.setup is not None and known(self.setup.field) and known(*self.setup.field):
            for n, one in enumerate(self.setup.field):
                if known(one.meaning) and one.meaning != "constant":
                    yield f"setup.field[{n}].meaning", one.meaning, "must be constant: nothing is commanded yet"


class Options(Table, frozen=True, kw_only=True):
    """What a rig's [device] table may say for `driver = "serial"`."""

    vendor_id: Annotated[int, within(USB_ID, "USB vendor; with neither, name path", 0x16C0)] | None = None
    product_id: Annotated[int, within(USB_ID, "USB product", 0x0483)] | None = None
    serial: Annotated[str, said("serial number, where several are attached", "SN42")] | None = None
    path: Annotated[str, said("port, in place of looking for one", "/dev/ttyACM0")] | None = None
    baud: Annotated[Baud, said("speed; a port of USB's own has none", 115200)] = 115200
    frames: Annotated[Frames | None, said("language of the board; absent: WoodenHaptics' text")] = None
    kinematics: Annotated[Kinematics | None, said("mechanism, with frames")] = None
    mounting: Mounting = Mounting()
    force_max_n: Annotated[float, within(FORCE_MAX_N, "most that it displays", 5.0)]
    stiffness_max_n_per_m: Annotated[float, within(limits.STIFFNESS_N_PER_M, "most that it renders stably", 1000.0)]
    damping_max_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "the same of damping", 8.0)]
    workspace_radius_m: Annotated[float, Meta(gt=0.0, le=1.0), said("about the device's origin", 0.1)]
    quiet_s: Annotated[float, within(SILENCE_S, "after so long without a frame no force is sent", 0.02)] = 0.02
    kick_s: Annotated[float, within(SILENCE_S, "a silent device is kicked so often", 0.1)] = 0.1
    timeout_s: Annotated[float, within(GIVE_UP_S, "after so long without a frame the device is given up", 0.2)] = 0.2
    wake_s: Annotated[float, within(WAKE_S, "time to wake the device when it is opened", 3.0)] = 3.0

    def faults(self) -> Iterator[Complaint]:
        if known(self.quiet_s, self.timeout_s) and self.timeout_s < self.quiet_s:
            yield "timeout_s", self.timeout_s, f"must be at least quiet_s = {self.quiet_s:g}, so that a kick can help"
        if known(self.vendor_id, self.product_id) and (self.vendor_id is None) != (self.product_id is None):
            yield "product_id", self.product_id, "needs vendor_id, and the other way round: give both or neither"
        if not known(self.frames, self.kinematics):
            return
        if self.frames is None or self.kinematics is None:
            if (self.frames is None) != (self.kinematics is None):
                yield "kinematics", msgspec.UNSET, "and frames belong together: describe both, or neither"
        elif known(self.frames.input, self.frames.output):
            yield from faults_of_fields("frames", self.frames.input.field, self.frames.output.field, self.kinematics)
