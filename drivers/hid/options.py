"""Configuration of a HID device: selection, bytes of its reports, kinematics, limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.limits import Range
from softfinger.config.materials import Library, LibraryEntry
from softfinger.config.schema import Complaint, Table, doc, is_usable, sized, within
from softfinger.drivers.fields.options import (
    BYTES,
    FIELDS,
    USB_ID,
    InputField,
    OutputField,
    check_layout,
    check_repeated_meanings,
)
from softfinger.drivers.kinematics.options import Chain, Kinematics, check_fields
from softfinger.drivers.mounting import MountedOptions, check_timeout

REPORT_ID: Final = Range(0, 255, "one byte; 0 if the device does not number its reports")
SILENCE_S: Final = Range(0.01, 0.2, "a kick needs at least this time; after a longer one the force is outdated")
GIVE_UP_S: Final = Range(0.01, 2.0, "a restart needs at least this time; a longer time hides a lost device")

Through = Literal["auto", "node", "thread"]
"""Carrier of the reports: the loop at a hidraw node, or threads at hidapi; auto: the loop if there is a node."""

LIBRARY: Final = Path(__file__).with_name("reports.toml")


class InputReport(Table, frozen=True, kw_only=True):
    """Report that the device sends."""

    bytes: Annotated[int, within(BYTES, "length without the report id, as in the descriptor", 8)]
    id: Annotated[int, within(REPORT_ID, "report id; 0: the device does not number its reports", 0)] = 0
    field: Annotated[tuple[InputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.bytes, self.field):
            return
        yield from check_layout(self.bytes, self.field, "a report", ", without the id")
        yield from check_repeated_meanings(self.field)


class OutputReport(Table, frozen=True, kw_only=True):
    """Report that the device receives; bytes without a field are 0."""

    bytes: Annotated[int, within(BYTES, "length without the report id, as in the descriptor", 8)]
    id: Annotated[int, within(REPORT_ID, "report id; 0: the device does not number its reports", 0)] = 0
    field: Annotated[tuple[OutputField, ...], sized(FIELDS, "its numbers")]

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.bytes, self.field):
            yield from check_layout(self.bytes, self.field, "a report", ", without the id")


@lru_cache(maxsize=1)
def _load_formats() -> Mapping[str, LibraryEntry]:
    formats = msgspec.toml.decode(LIBRARY.read_bytes(), type=dict[str, dict[str, Any]])
    return {name: LibraryEntry(about=name, holds="", papers=(), values=reports) for name, reports in formats.items()}


class Reports(Table, frozen=True, kw_only=True):
    """The wire format: one of the library by name, or every report described."""

    library: ClassVar[Library] = Library("name", _load_formats, marked=False)
    """Shipped formats; a rig that names one uses its reports where it defines none."""

    name: Annotated[str, sized(limits.NAME_LENGTH, "a format of the library", "woodenhaptics-v2")] | None = None
    input: InputReport
    output: OutputReport
    preset: Annotated[OutputReport | None, doc("report that sets the counts of encoders a, b, c")] = None

    def faults(self) -> Iterator[Complaint]:
        if (
            not is_usable(self.output, self.preset)
            or self.preset is None
            or not is_usable(self.output.bytes, self.output.id)
        ):
            return
        if (self.preset.bytes, self.preset.id) != (self.output.bytes, self.output.id):
            described = f"{self.output.bytes} bytes with id {self.output.id}"
            yield "preset.bytes", self.preset.bytes, f"must have the length and id of the output report: {described}"


class Options(MountedOptions, frozen=True, kw_only=True):
    """Keys of a rig's [device] with `driver = "hid"`."""

    vendor_id: Annotated[int, within(USB_ID, "USB vendor", 0x1234)]
    product_id: Annotated[int, within(USB_ID, "USB product", 0x0006)]
    serial: Annotated[str, doc("serial number, if several are attached", "SN42")] | None = None
    path: Annotated[str, doc("node, or path of hidapi on USB; default: searched for", "/dev/hidraw0")] | None = None
    through: Annotated[
        Through, doc("node: by the servo loop; thread: by threads through hidapi; auto: node if available", "auto")
    ] = "auto"
    reports: Reports
    kinematics: Kinematics
    calibrate: Annotated[
        bool, doc("set the encoder counts when opened; the arm must be in its calibration pose", False)
    ] = False
    kick_s: Annotated[float, within(SILENCE_S, "time without a report after which a zero is sent", 0.01)] = 0.01
    timeout_s: Annotated[
        float, within(GIVE_UP_S, "time without a report after which the device counts as lost", 0.1)
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        yield from check_timeout(self, "kick_s", "kick")
        if is_usable(self.path, self.through) and self.through == "node" and not (self.path or "/").startswith("/"):
            fault = 'is a path of hidapi on USB, but through = "node" needs a node such as /dev/hidraw0'
            yield "path", self.path, fault
        if not is_usable(self.reports, self.kinematics):
            return
        reports, kinematics = self.reports, self.kinematics
        if is_usable(reports.input, reports.output, reports.preset):
            yield from check_fields("reports", reports.input.field, reports.output.field, kinematics)
        if self.calibrate is True and not isinstance(kinematics, Chain):
            yield "calibrate", True, "is for chains only, which have a calibration pose: set it to false"
