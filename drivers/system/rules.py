"""Permission to open devices: udev rules for every claimed device, and the command that installs them."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Iterator
from typing import Final

from softfinger.config.schema import DeviceConfig
from softfinger.drivers.system.claims import Claim, list_claims

GROUP: Final = "softfinger"
"""Group with the same permission as the user at the machine, for ssh and services."""

PERMISSION: Final = f'TAG+="uaccess", ENV{{SOFTFINGER_GROUP}}="{GROUP}"'
MATCHES: Final = {
    "usb": 'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", ATTR{idVendor}=="',
    "hid": 'SUBSYSTEM=="hidraw", ATTRS{idVendor}=="',
    "serial": 'SUBSYSTEM=="tty", ATTRS{idVendor}=="',
}
"""Match of the nodes of a bus, up to the vendor."""

HEAD: Final = f"""\
# Devices that softfinger drives: for the user at this machine, and for the group {GROUP}.
# Below 73, where systemd acts on the tag uaccess.
ACTION=="remove", GOTO="softfinger_end"
"""
# The rules set the group through a variable: udev resolves a literal name when it reads the file, and drops a line with
# a group that does not exist yet.
TAIL: Final = f"""\
# prevents deep sleep of processors while the servo runs
SUBSYSTEM=="misc", KERNEL=="cpu_dma_latency", ENV{{SOFTFINGER_GROUP}}="{GROUP}"

ENV{{SOFTFINGER_GROUP}}=="?*", GROUP="$env{{SOFTFINGER_GROUP}}", MODE="0660"
LABEL="softfinger_end"
"""


def make_udev_rules(devices: Iterable[DeviceConfig] = ()) -> str:
    """Return the rules file for every device that a driver claims, and for the devices of [device] tables of a rig."""
    products: dict[tuple[str, str, int], set[int]] = {}
    """Product ids by driver, bus and vendor; an empty set stands for all products of the vendor."""
    for claim in (*list_claims(), *_iter_claims_of_devices(devices)):
        if claim.driver == "haply":  # the maker's service opens it, and installs rules for it
            continue
        # libusb is used if there is no hidraw node; how 3D Systems' library opens the Touch HID is not public
        for bus in (claim.bus, *(["usb"] if claim.bus == "hid" and claim.driver != "spacemouse" else [])):
            vendor_products = products.setdefault((claim.driver, bus, claim.vendor), set())
            vendor_products |= set() if claim.product is None else {claim.product}
    lines = [HEAD]
    for (driver, bus, vendor), numbers in products.items():
        lines.append(f"# {driver}\n{_format_rule(bus, vendor, numbers)}\n")
    return "\n".join([*lines, TAIL])


def find_program_command() -> list[str]:
    """Return the command that starts this program from any folder, also as root with a different PATH."""
    script = os.path.join(os.path.dirname(sys.executable), "softfinger")
    return [script] if os.path.exists(script) else [sys.executable, "-m", "softfinger.server.cli"]


def install_command(vendor: int | None = None, product: int | None = None) -> str:
    """Return the command for root that permits opening a device of these ids (default: any), once and for all."""
    is_claimed = vendor is None or any(
        claim.vendor == vendor and claim.product in (None, product) for claim in list_claims()
    )
    return shlex.join(["sudo", *find_program_command(), "install", "--system"]) + (
        "" if is_claimed else " --rig YOUR-RIG.toml"
    )


def explain_permission(vendor: int, product: int) -> str:
    """Return the remedy for a missing permission, for a message."""
    return f"run `{install_command(vendor, product)}`, and plug the device in again"


def _iter_claims_of_devices(devices: Iterable[DeviceConfig]) -> Iterator[Claim]:
    """Yield a claim for each device that a rig describes by its ids."""
    for device in devices:
        vendor, product = device.options.get("vendor_id"), device.options.get("product_id")
        if isinstance(vendor, int) and isinstance(product, int):
            yield Claim(device.driver, "serial" if device.driver == "serial" else "hid", vendor, product)


def _format_rule(bus: str, vendor: int, products: set[int]) -> str:
    rule = f'{MATCHES[bus]}{vendor:04x}", '
    if products:
        rule += f"{MATCHES[bus].rpartition(', ')[2].replace('Vendor', 'Product')}"
        rule += "|".join(f"{number:04x}" for number in sorted(products)) + '", '
    # otherwise ModemManager probes a serial port with its commands
    return rule + PERMISSION + (', ENV{ID_MM_DEVICE_IGNORE}="1"' if bus == "serial" else "")
