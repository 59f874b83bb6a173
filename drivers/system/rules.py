"""Who may open devices: the udev rules for all that a driver claims, and the command that puts them in place."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Iterator
from typing import Final

from softfinger.config.schema import DeviceConfig
from softfinger.drivers.system.claims import Claim, claims

GROUP: Final = "softfinger"
"""Who may do what a user at the machine may: over ssh, and as a service."""

ALLOWED: Final = f'TAG+="uaccess", ENV{{SOFTFINGER_GROUP}}="{GROUP}"'
MATCHES: Final = {
    "usb": 'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", ATTR{idVendor}=="',
    "hid": 'SUBSYSTEM=="hidraw", ATTRS{idVendor}=="',
    "serial": 'SUBSYSTEM=="tty", ATTRS{idVendor}=="',
}
"""How the nodes of a bus are told from others, up to the vendor."""

HEAD: Final = f"""\
# Devices that softfinger drives: for whoever sits at this machine, and for the group {GROUP}.
# Below 73, where systemd acts on the tag uaccess.
ACTION=="remove", GOTO="softfinger_end"
"""
# The group by way of a variable: a name that is written here would be looked up when the file is read, and a line whose
# group is not there yet is dropped.
TAIL: Final = f"""\
# keeps processors out of deep sleep while the servo runs
SUBSYSTEM=="misc", KERNEL=="cpu_dma_latency", ENV{{SOFTFINGER_GROUP}}="{GROUP}"

ENV{{SOFTFINGER_GROUP}}=="?*", GROUP="$env{{SOFTFINGER_GROUP}}", MODE="0660"
LABEL="softfinger_end"
"""


def udev_rules(devices: Iterable[DeviceConfig] = ()) -> str:
    """The file of rules: for every device that a driver claims, and those of a rig's [device] tables."""
    products: dict[tuple[str, str, int], set[int]] = {}
    """By driver, bus and vendor; an empty set: all of the vendor."""
    for claim in (*claims(), *_described(devices)):
        if claim.driver == "haply":  # the maker's service opens it, and has rules of its own
            continue
        for bus in (claim.bus, *(["usb"] if claim.driver == "hid" else [])):  # without a hidraw node it is opened there
            of_vendor = products.setdefault((claim.driver, bus, claim.vendor), set())
            of_vendor |= set() if claim.product is None else {claim.product}
    lines = [HEAD]
    for (driver, bus, vendor), numbers in products.items():
        lines.append(f"# {driver}\n{_rule(bus, vendor, numbers)}\n")
    return "\n".join([*lines, TAIL])


def program() -> list[str]:
    """How this program is started from anywhere, by root too, who has a path of his own."""
    script = os.path.join(os.path.dirname(sys.executable), "softfinger")
    return [script] if os.path.exists(script) else [sys.executable, "-m", "softfinger.server.cli"]


def command(vendor: int | None = None, product: int | None = None) -> str:
    """What root has to run once, so that a device of these ids, by default any, may be opened by its users."""
    known = vendor is None or any(claim.vendor == vendor and claim.product in (None, product) for claim in claims())
    return shlex.join(["sudo", *program(), "install", "--system"]) + ("" if known else " --rig YOUR-RIG.toml")


def how_to_permit(vendor: int, product: int) -> str:
    """What a user has to do who may not open a device, for an error's message."""
    return f"run `{command(vendor, product)}`, and plug the device in again"


def _described(devices: Iterable[DeviceConfig]) -> Iterator[Claim]:
    """A claim for each device that a rig describes by its ids."""
    for device in devices:
        vendor, product = device.options.get("vendor_id"), device.options.get("product_id")
        if isinstance(vendor, int) and isinstance(product, int):
            yield Claim(device.driver, "serial" if device.driver == "serial" else "hid", vendor, product)


def _rule(bus: str, vendor: int, products: set[int]) -> str:
    rule = f'{MATCHES[bus]}{vendor:04x}", '
    if products:
        rule += f"{MATCHES[bus].rpartition(', ')[2].replace('Vendor', 'Product')}"
        rule += "|".join(f"{number:04x}" for number in sorted(products)) + '", '
    # ModemManager would try a serial port with commands of its own
    return rule + ALLOWED + (', ENV{ID_MM_DEVICE_IGNORE}="1"' if bus == "serial" else "")
