"""Check that an attached device has the reports that a rig describes; its ids do not identify them.

Boards with other programs share the ids of one vendor, and one board may have several interfaces under its ids.
"""

from __future__ import annotations

from softfinger.config.errors import DeviceError
from softfinger.drivers.hid.options import Reports, library_lengths
from softfinger.drivers.system.descriptor import Announced, announced


def lengths(reports: Reports) -> Announced:
    """Return the reports that a rig describes."""
    return Announced({reports.input.id: reports.input.bytes}, {reports.output.id: reports.output.bytes})


def fits(descriptor: bytes, reports: Reports) -> bool:
    """Return True if a descriptor announces the reports of a rig; also True for an unknown descriptor."""
    try:
        return not descriptor or announced(descriptor).has(lengths(reports))
    except ValueError:
        return True  # opening reports the damage


def check_reports(descriptor: bytes, path: str, reports: Reports) -> None:
    """Raise DeviceError, with both lists, if the device at `path` announces other reports than the rig describes."""
    try:
        theirs = announced(descriptor)
    except ValueError as error:
        raise DeviceError(f"{path}: its report descriptor is damaged: {error}") from error
    ours = lengths(reports)
    if theirs.has(ours):
        return
    known = [name for name, one in library_lengths().items() if theirs.has(one)]
    hint = f'set reports to "{known[0]}", whose they are' if known else "correct [device.reports]"
    raise DeviceError(
        f"{path} has other reports than the rig: the device announces {theirs}; the rig describes {ours}: "
        f"{hint} (descriptor {descriptor.hex()})"
    )
