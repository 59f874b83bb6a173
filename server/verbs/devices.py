"""`softfinger devices`: list attached devices, their drivers, why they cannot be opened, and the remedies."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import DeviceBusy, HapticError
from softfinger.config.load import build, load_rig
from softfinger.config.schema import DeviceConfig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers import registry
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import Claim, find_claim
from softfinger.drivers.system.diagnosis import Diagnosis, diagnose, diagnose_requirements, read_options
from softfinger.drivers.system.discovery import SystemDevice

OPENABLE_STATES: Final = ("usable", "firmware")
"""States in which a device can be opened. Only an opened Falcon can report whether its firmware is loaded."""


UNLISTED: Final = {
    "forcedimension": SystemDevice("library", 0, 0, "device of Force Dimension's library", "", ""),
    "haply": SystemDevice("service", 0, 0, "devices of Haply's Inverse Service", "", ""),
    "openhaptics": SystemDevice("library", 0, 0, "device of 3D Systems' library: Ethernet, FireWire, or USB", "", ""),
}
"""By driver, the entry for a device that the system does not list, but the maker's library or service may know."""

ListedDevice = tuple[SystemDevice, Claim | None, Diagnosis, Mapping[str, Any] | None]
"""Device, claim of its driver, diagnosis, and identification that the device reported."""


def run(args: argparse.Namespace) -> int:
    rig = None if args.rig is None else find_single_device(load_rig(args.rig))
    devices: list[ListedDevice] = []
    for device in discovery.list_attached():
        claim = find_claim(device)
        diagnosis, identification = diagnose(device, claim, rig), None
        if args.ask and claim is not None and diagnosis.state in OPENABLE_STATES:
            diagnosis, identification = identify_device(device, claim, rig)
        devices.append((device, claim, diagnosis, identification))
    attached_drivers = {claim.driver for _, claim, *_ in devices if claim is not None}
    if args.ask and rig is not None and rig.driver in UNLISTED and rig.driver not in attached_drivers:
        devices.append(ask_rig(rig, str(args.rig)))
    if args.json:
        print(json.dumps({"usb": discovery.has_usb(), "devices": [as_map(*row) for row in devices]}, indent=2))
    else:
        print("\n".join(format_lines(devices)))
    return 0


def ask_rig(rig: DeviceConfig, name: str) -> ListedDevice:
    """Ask the library or service of a rig for its device, because the system does not list one."""
    device = UNLISTED[rig.driver]
    claim = Claim(rig.driver, device.bus, device.vendor, device.product, (name,))
    diagnosis, identification = diagnose_requirements(claim, rig.options), None
    if diagnosis.state in OPENABLE_STATES:
        diagnosis, identification = identify_device(device, claim, rig)
    return device, claim, diagnosis, identification


def identify_device(
    device: SystemDevice, claim: Claim, rig: DeviceConfig | None = None
) -> tuple[Diagnosis, dict[str, Any] | None]:
    """Open a free device and read its identification; return the diagnosis and the identification by name.

    The identification is None if the driver has no `identify`, or if the device could not be opened.
    """
    driver, options = registry.load(claim.driver), read_options(claim, rig)
    identify = getattr(driver, "identify", None)
    if identify is None:
        return diagnose_requirements(claim, options), None
    try:
        identification = identify(device, build(driver.Options, dict(options), "[device]"))
    except HapticError as error:
        return Diagnosis("busy" if isinstance(error, DeviceBusy) else "error", str(error)), None
    return diagnose_requirements(claim, options, identification), identification


def as_map(
    device: SystemDevice, claim: Claim | None, diagnosis: Diagnosis, identification: Mapping[str, Any] | None = None
) -> dict[str, object]:
    """Return a device as a mapping for `--json`."""
    return {
        "name": device.name,
        "bus": device.bus,
        "vendor_id": f"{device.vendor:04x}",
        "product_id": f"{device.product:04x}",
        "serial": device.serial,
        "node": device.node,
        "driver": claim.driver if claim else None,
        "rigs": list(claim.rigs) if claim else [],
        **diagnosis._asdict(),
        "said": identification,
    }


def _format_value(value: Any) -> str:
    return (" and ".join(value) or "none") if isinstance(value, list) else str(value)


def format_lines(devices: list[ListedDevice]) -> list[str]:
    """Return the list as text: devices with a driver first, then the others."""
    text = []
    for device, claim, diagnosis, identification in sorted(devices, key=lambda row: row[1] is None):
        place = () if device.bus in ("library", "service") else (device.node or "no node", device.ids)
        text.append("  ".join((*place, device.name)))
        if claim is None:
            hint = f": {diagnosis.remedy}" if diagnosis.remedy else ""
            text.append(f"    {diagnosis.reason}{hint}")
            continue
        command = " or ".join(f"--rig {name}" for name in claim.rigs) or f"--device {claim.driver}"
        text.append(f"    driver {claim.driver}: softfinger run {command}")
        text.append(f"    {diagnosis.state}{': ' if diagnosis.reason else ''}{diagnosis.reason}")
        if identification is not None:
            answer = ", ".join(f"{name} {_format_value(value)}" for name, value in identification.items())
            text.append(f"    it reports: {answer}")
        if diagnosis.remedy:
            text.append(f"    remedy: {diagnosis.remedy}")
    if not any(claim for _, claim, *_ in devices):
        message = "no attached device is supported by a driver" if devices else "no USB or HID device is attached"
        bus = (
            "" if discovery.has_usb() else f"; this system has no USB bus ({Path('/') / discovery.USB} does not exist)"
        )
        text.append(f"{message}{bus}. Without hardware: softfinger run, or softfinger run --rig simulated")
    return text
