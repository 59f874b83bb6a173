"""Check that an attached device has the reports that a rig describes; its ids do not identify them.

Boards with other programs share the ids of one vendor, and one board may have several interfaces under its ids.
"""

from __future__ import annotations

from softfinger.config.errors import DeviceError
from softfinger.drivers.hid.options import Reports
from softfinger.drivers.system.claims import read_report_lengths
from softfinger.drivers.system.descriptor import ReportLengths, parse_descriptor


def parse_report_lengths(reports: Reports) -> ReportLengths:
    return ReportLengths({reports.input.id: reports.input.bytes}, {reports.output.id: reports.output.bytes})


def has_reports(descriptor: bytes, reports: Reports) -> bool:
    """Return True if a descriptor announces the reports of a rig; also True for an unknown descriptor."""
    try:
        return not descriptor or parse_descriptor(descriptor).includes(parse_report_lengths(reports))
    except ValueError:
        return True  # opening reports the damage


def check_reports(descriptor: bytes, path: str, reports: Reports) -> None:
    """Raise DeviceError, with both lists, if the device at `path` announces other reports than the rig describes."""
    try:
        announced = parse_descriptor(descriptor)
    except ValueError as error:
        raise DeviceError(f"{path}: its report descriptor is damaged: {error}") from error
    expected = parse_report_lengths(reports)
    if announced.includes(expected):
        return
    matching_names = [name for name, lengths in read_report_lengths().items() if announced.includes(lengths)]
    hint = (
        f'set reports to "{matching_names[0]}", which has these reports'
        if matching_names
        else "correct [device.reports]"
    )
    raise DeviceError(
        f"{path} has different reports from the rig: the device reports {announced}; the rig describes {expected}: "
        f"{hint} (descriptor {descriptor.hex()})"
    )
