"""Configuration of a device on a serial port: selection, frames, mechanism, limits and timeouts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final, Literal, get_args

import msgspec
from msgspec import Meta

from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Table, doc, is_usable, sized, within
from softfinger.drivers.fields.options import (
    FIELDS,
    TYPE_BYTES,
    USB_ID,
    InputField,
    OutputField,
    check_layout,
    check_repeated_meanings,
)
from softfinger.drivers.kinematics.options import Kinematics, check_fields
from softfinger.drivers.mounting import MountedOptions, check_timeout

FORCE_MAX_N: Final = Range(0.0, 32.0, "a frame stores mN in two bytes, up to 32.767 N")
SILENCE_S: Final = Range(
    0.005, 0.2, "a shorter time counts late answers as silence; after a longer one the force is outdated"
)
GIVE_UP_S: Final = Range(0.005, 2.0, "a shorter time counts late answers as silence; a longer one hides a lost device")
WAKE_S: Final = Range(0.2, 60.0, "a restart needs at least this time; waiting more than a minute is useless")

FRAME_BYTES: Final = Range(1, 256, "at 115200 Bd a frame of 256 bytes takes 22 ms")
MARKS: Final = Range(0, 8, "more bytes than the markers of any protocol")
RESYNC: Final = Range(1, 256, "the longest frame")

Order = Literal["little", "big"]
Mode = Literal["answer", "stream"]
Check = Literal["sum8", "xor8", "crc8", "crc16-ccitt", "crc16-modbus"]
CHECKS: Final[tuple[str, ...]] = get_args(Check)
"""Kinds of checksum; kernels use the index in this tuple."""
CHECK_BYTES: Final = {name: 2 if name.startswith("crc16") else 1 for name in CHECKS}
Baud = Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 921600, 1000000, 2000000]
Byte = Annotated[int, Meta(ge=0, le=255)]


class Checksum(Table, frozen=True, kw_only=True):
    """Checksum of a frame.

    One byte: sum8, xor8 (exclusive or), crc8 (polynomial 0x07, initial value 0). Two bytes, initial value 0xFFFF:
    crc16-ccitt (polynomial 0x1021), crc16-modbus (0x8005 reflected).
    """

    kind: Annotated[Check, doc("computation", "crc8")]
    offset: Annotated[
        int,
        Meta(ge=1, le=int(FRAME_BYTES.high)),
        doc("index of its first byte; it covers the bytes from `first` up to it", 6),
    ]
    first: Annotated[int, Meta(ge=0, le=int(FRAME_BYTES.high)), doc("index of the first byte that it covers", 0)] = 0


class Frame(Table, frozen=True, kw_only=True):
    """Common properties of frames in both directions."""

    bytes: Annotated[int, within(FRAME_BYTES, "length, including markers and checksum", 8)]
    start: Annotated[tuple[Byte, ...], sized(MARKS, "first bytes of the frame", [165])] = ()
    end: Annotated[tuple[Byte, ...], sized(MARKS, "last bytes of the frame", [10])] = ()
    check: Checksum | None = None

    def is_searchable(self) -> bool:
        """Return True if frames can be found in a stream of bytes."""
        return self.check is not None or bool(self.start and self.end)

    def find_reserved_bytes(self) -> Iterator[tuple[int, str]]:
        """Yield bytes used by marks or checksum, with the name of the use."""
        yield from ((k, "start") for k in range(len(self.start)))
        yield from ((k, "end") for k in range(self.bytes - len(self.end), self.bytes))
        if self.check is not None:
            yield from ((self.check.offset + k, "check") for k in range(CHECK_BYTES[self.check.kind]))


def check_frame(frame: Frame, fields: tuple[InputField | OutputField, ...]) -> Iterator[Complaint]:
    """Yield complaints about marks, a checksum and fields that exceed a frame or overlap."""
    if not is_usable(frame.bytes, frame.start, frame.end, frame.check, fields) or not is_usable(*fields):
        return
    yield from check_layout(frame.bytes, fields, "a frame")
    if frame.check is not None:
        if not is_usable(frame.check.kind, frame.check.offset, frame.check.first):
            return
        if frame.check.first >= frame.check.offset:
            fault = f"must be below offset = {frame.check.offset}, otherwise it covers no byte"
            yield "check.first", frame.check.first, fault
    uses = dict[int, str]()
    for byte, name in frame.find_reserved_bytes():
        if not 0 <= byte < frame.bytes or byte in uses:
            yield name, byte, f"byte {byte} is {uses.get(byte, f'beyond a frame of {frame.bytes}')}: move it"
            return
        uses[byte] = name
    for index, field in enumerate(fields):
        if is_usable(field.offset, field.type):
            for byte in range(field.offset, field.offset + TYPE_BYTES[field.type]):
                if byte in uses:
                    yield f"field[{index}].offset", field.offset, f"byte {byte} belongs to {uses[byte]}: move one"
                    break


class InputFrame(Frame, frozen=True, kw_only=True):
    """Frame from the board. Of a stream it needs a check, or both start and end."""

    field: Annotated[tuple[InputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        yield from check_frame(self, self.field)
        if is_usable(self.field):
            yield from check_repeated_meanings(self.field)


class OutputFrame(Frame, frozen=True, kw_only=True):
    """Frame to the board.

    `output` is sent on each tick, `setup` at opening until the board answers, and at closing. Other bytes are 0.
    """

    field: Annotated[tuple[OutputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        yield from check_frame(self, self.field)


class Resync(Table, frozen=True, kw_only=True):
    """Bytes in front of a zero after a missing answer; they complete a truncated frame, and the board ignores them."""

    byte: Annotated[Byte, doc("the byte", 3)]
    count: Annotated[int, within(RESYNC, "number of these bytes: the length of a frame", 9)]


class Frames(Table, frozen=True, kw_only=True):
    """Frames of the board; without them it uses WoodenHaptics' text."""

    mode: Annotated[Mode, doc("answer: the board answers each frame; stream: it sends continuously", "answer")]
    order: Annotated[Order, doc("byte order of numbers", "little")] = "little"
    input: InputFrame
    output: OutputFrame
    setup: Annotated[
        OutputFrame | None,
        doc("frame sent when the port is opened and when it is closed; all its fields are constants"),
    ] = None
    resync: Resync | None = None

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.mode, self.input) and self.mode == "stream":
            marks = (self.input.start, self.input.end, self.input.check)
            if is_usable(*marks) and not self.input.is_searchable():
                fault = "a stream needs a check, or start and end, so that its frames can be found: add one"
                yield "input", msgspec.UNSET, fault
        if (
            is_usable(self.setup)
            and self.setup is not None
            and is_usable(self.setup.field)
            and is_usable(*self.setup.field)
        ):
            for index, field in enumerate(self.setup.field):
                if is_usable(field.meaning) and field.meaning != "constant":
                    fault = "must be constant, since it is sent before the first command"
                    yield f"setup.field[{index}].meaning", field.meaning, fault


class Options(MountedOptions, frozen=True, kw_only=True):
    """Keys for `driver = "serial"`."""

    vendor_id: Annotated[int, within(USB_ID, "USB vendor of the port; without the ids, path", 0x16C0)] | None = None
    product_id: Annotated[int, within(USB_ID, "USB product of the port", 0x0483)] | None = None
    serial: Annotated[str, doc("serial number, if several are attached", "SN42")] | None = None
    path: (
        Annotated[str, doc("the port; default: the one with the ids; one on USB must have them", "/dev/ttyACM0")] | None
    ) = None
    baud: Annotated[Baud, doc("speed in Bd; without effect on a native USB port", 115200)] = 115200
    frames: Annotated[Frames | None, doc("protocol of the board; default: the text protocol of WoodenHaptics")] = None
    kinematics: Annotated[Kinematics | None, doc("mechanism, with frames")] = None
    force_max_n: Annotated[float, within(FORCE_MAX_N, "largest force displayed", 5.0)]
    quiet_s: Annotated[float, within(SILENCE_S, "silence after which the force is removed", 0.02)] = 0.02
    kick_s: Annotated[float, within(SILENCE_S, "period of the frames that wake a silent board", 0.1)] = 0.1
    timeout_s: Annotated[float, within(GIVE_UP_S, "silence after which the run ends", 0.2)] = 0.2
    wake_s: Annotated[float, within(WAKE_S, "time to wake it at opening", 3.0)] = 3.0

    def faults(self) -> Iterator[Complaint]:
        yield from check_timeout(self, "quiet_s", "kick")
        if is_usable(self.vendor_id, self.product_id) and (self.vendor_id is None) != (self.product_id is None):
            yield "product_id", self.product_id, "vendor_id and product_id belong together: set both or none"
        if not is_usable(self.frames, self.kinematics):
            return
        if self.frames is None or self.kinematics is None:
            if (self.frames is None) != (self.kinematics is None):
                yield "kinematics", msgspec.UNSET, "and frames belong together: set both or none"
        elif is_usable(self.frames.input, self.frames.output):
            yield from check_fields("frames", self.frames.input.field, self.frames.output.field, self.kinematics)
