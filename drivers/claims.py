"""Which driver a device belongs to, by its USB ids, without an import of that driver.

A device whose ids a rig of this program names (`driver = "hid"` or `"serial"`) belongs to that rig.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Final, NamedTuple

from softfinger.config.load import load_rig, shipped
from softfinger.config.schema import Rig
from softfinger.drivers.discovery import Attached, Bus

PUCKS: Final = (
    *((0x046D, product) for product in (0xC625, 0xC626, 0xC627, 0xC629, 0xC62B)),
    *((0x256F, product) for product in (0xC62E, 0xC632, 0xC633, 0xC635, 0xC638, 0xC63A, 0xC652)),
)
"""Ids of 3Dconnexion's pucks and their receivers."""


class Claim(NamedTuple):
    """A driver's word that devices of these ids are its own; `product` None: every one of the vendor."""

    driver: str
    bus: Bus
    vendor: int
    product: int | None
    rigs: tuple[str, ...] = ()


def claim_on(device: Attached) -> Claim | None:
    """Who claims a device, with the shipped rigs for it; None if nobody does.

    A driver over hidraw or a serial port claims the device on the USB bus too: it is there without a node when the
    system's support for these is missing.
    """
    for claim in claims():
        if claim.vendor == device.vendor and claim.product in (None, device.product):
            return claim
    return None


@cache
def claims() -> tuple[Claim, ...]:
    """Every claim. The rigs are read once: they belong to the program and stay what they are while it runs."""
    return tuple(_claims())


def _claims() -> Iterator[Claim]:
    rigs: dict[tuple[str, int | None, int | None], list[str]] = {}
    for name in shipped(Rig):
        device = load_rig(name).device
        ids = (device.driver, device.options.get("vendor_id"), device.options.get("product_id"))
        rigs.setdefault(ids, []).append(name)

    def of(driver: str) -> tuple[str, ...]:
        return tuple(rigs.get((driver, None, None), ()))

    yield Claim("forcedimension", "usb", 0x1451, None, of("forcedimension"))
    yield Claim("falcon", "usb", 0x0403, 0xCB48, of("falcon"))
    for vendor, product in PUCKS:
        yield Claim("spacemouse", "hid", vendor, product, of("spacemouse"))
    for (driver, vendor_id, product_id), names in rigs.items():
        if vendor_id is not None and product_id is not None:
            yield Claim(driver, "serial" if driver == "serial" else "hid", vendor_id, product_id, tuple(names))
