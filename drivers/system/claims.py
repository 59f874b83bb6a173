"""Assignment of devices to drivers by USB ids, without importing the driver.

A device with ids from a shipped rig (`driver = "hid"` or `"serial"`) belongs to that rig, if it has the rig's reports
and no product string of another maker: other programs use boards with the same ids.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.load import load_rig
from softfinger.config.schema import Rig
from softfinger.config.sources import list_shipped
from softfinger.drivers.system.descriptor import ReportLengths, parse_descriptor
from softfinger.drivers.system.discovery import NO_PRODUCT, Bus, SystemDevice

PUCKS: Final = (
    *((0x046D, product) for product in (0xC625, 0xC626, 0xC627, 0xC628, 0xC629, 0xC62B)),
    *(
        (0x256F, product)
        for product in (0xC62E, 0xC62F, 0xC631, 0xC632, 0xC633, 0xC635, 0xC636, 0xC638, 0xC63A, 0xC652)
    ),
)
"""Ids of 3Dconnexion pucks and their receivers."""

TOUCHES: Final[tuple[tuple[Bus, int, int | None], ...]] = (
    ("serial", 0x0301, 0x2988),
    ("serial", 0x2988, None),
    ("hid", 0x2988, 0x0304),
)
"""Ids of 3D Systems' devices on USB: the first Touch with USB, its successors (0302), the Touch HID.

The first one has vendor and product exchanged. Devices with Ethernet or FireWire have no ids.
"""

TEENSY_SERIAL: Final = (0x16C0, 0x0483)
"""Ids of every Teensy with a serial port, regardless of its program."""


class Claim(NamedTuple):
    """Claim of a driver to the devices of these ids; `product` None: every product of the vendor.

    reports  reports that a HID device has to announce; None: any
    """

    driver: str
    bus: Bus
    vendor: int
    product: int | None
    rigs: tuple[str, ...] = ()
    reports: ReportLengths | None = None


def find_claim(device: SystemDevice) -> Claim | None:
    """Return the claim to a device, with the shipped rigs for it; None if no driver claims it.

    Drivers of hidraw nodes and serial ports also claim the device on the USB bus, where it is listed without a node if
    the system lacks support for these nodes.
    """
    is_haply = is_inverse3(device)
    matching = [
        claim
        for claim in find_claims(device)
        if (claim.driver == "haply") == is_haply and _has_reports(device, claim.reports)
    ]
    if len(matching) < 2:
        return matching[0] if matching else None
    return matching[0]._replace(rigs=tuple(rig for claim in matching for rig in claim.rigs), reports=None)


def find_claims(device: SystemDevice) -> list[Claim]:
    """Return the claims to the ids of a device, regardless of its reports and product string.

    A claim to every product of a vendor holds for those without a claim of their own.
    """
    of_vendor = [claim for claim in list_claims() if claim.vendor == device.vendor]
    of_product = [claim for claim in of_vendor if claim.product == device.product]
    return of_product or [claim for claim in of_vendor if claim.product is None]


def is_inverse3(device: SystemDevice) -> bool:
    """Return True for a Haply Inverse3, which has the ids of any Teensy, by its product string."""
    return (device.vendor, device.product) == TEENSY_SERIAL and device.name.lower().startswith("haply")


def matches_device(device: SystemDevice, options: Mapping[str, Any]) -> bool:
    """Return True if a device matches the USB ids and reports in a rig's [device] table."""
    if (device.vendor, device.product) != (options["vendor_id"], options.get("product_id")) or is_inverse3(device):
        return False
    format_ = options.get("reports")
    return _has_reports(device, read_report_lengths().get(format_ if isinstance(format_, str) else None))


def explain_ambiguity(device: SystemDevice) -> str | None:
    """Return why ids and product string do not identify a device; None if they do.

    The product string of WoodenHaptics' board is unpublished, so no string identifies it.
    """
    if (device.vendor, device.product) != TEENSY_SERIAL or is_inverse3(device):
        return None
    product_text = "it names no product" if device.name == NO_PRODUCT else f"its product is '{device.name}'"
    return f"{product_text}, and {device.ids} matches any Teensy with a serial port, with any firmware"


def _has_reports(device: SystemDevice, required: ReportLengths | None) -> bool:
    if required is None or not device.descriptor:
        return True
    try:
        return parse_descriptor(device.descriptor).includes(required)
    except ValueError:
        return False


@cache
def list_claims() -> tuple[Claim, ...]:
    """Return every claim. The shipped rigs are read once, because they do not change at run time."""
    return tuple(_iter_claims())


def _iter_claims() -> Iterator[Claim]:
    rigs: dict[tuple[str, int | None, int | None], dict[str | None, list[str]]] = {}
    for name in list_shipped(Rig):
        device = load_rig(name).device
        if device is None:  # a rig of several devices; other rigs describe each of them
            continue
        ids = (device.driver, device.options.get("vendor_id"), device.options.get("product_id"))
        format_ = device.options.get("reports")
        formats = rigs.setdefault(ids, {})
        formats.setdefault(format_ if isinstance(format_, str) else None, []).append(name)

    def rigs_of(driver: str) -> tuple[str, ...]:
        return tuple(rigs.get((driver, None, None), {}).get(None, ()))

    yield Claim("forcedimension", "usb", 0x1451, None, rigs_of("forcedimension"))
    yield Claim("falcon", "usb", 0x0403, 0xCB48, rigs_of("falcon"))
    yield Claim("haply", "serial", *TEENSY_SERIAL, rigs_of("haply"))
    for bus, vendor, product in TOUCHES:
        yield Claim("openhaptics", bus, vendor, product, rigs_of("openhaptics"))
    for vendor, product in PUCKS:
        yield Claim("spacemouse", "hid", vendor, product, rigs_of("spacemouse"))
    for (driver, vendor_id, product_id), by_format in rigs.items():
        if vendor_id is not None and product_id is not None:
            for format_, names in by_format.items():
                described: Bus = "serial" if driver == "serial" else "hid"
                yield Claim(driver, described, vendor_id, product_id, tuple(names), read_report_lengths().get(format_))


@cache
def read_report_lengths() -> dict[str | None, ReportLengths]:
    """Return the report lengths of every shipped format, read here without importing its driver."""
    file = Path(__file__).parents[1] / "hid" / "reports.toml"
    return {
        name: ReportLengths(*({reports[way].get("id", 0): reports[way]["bytes"]} for way in ("input", "output")))
        for name, reports in tomllib.loads(file.read_text(encoding="utf-8")).items()
    }
