"""`devices`: what is attached, which driver claims it, why it cannot be opened, and the command that mends it."""

from __future__ import annotations

import argparse
import importlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.errors import HapticError
from softfinger.config.load import load_rig
from softfinger.config.schema import DeviceConfig
from softfinger.drivers import discovery, registry
from softfinger.drivers.claims import Claim, claim_on
from softfinger.drivers.discovery import Attached

MODULES: Final = {"hid": ("hidraw node", "usbhid"), "serial": ("serial port", "cdc_acm")}
"""What the system gives a device of a bus, and the module of the kernel that makes it."""


class Diagnosis(NamedTuple):
    """Whether a device can be used, in a word; if not, why and what to do.

    state   usable, unclaimed, or what is in the way: driver, node, permission, busy, library, firmware
    """

    state: str
    reason: str = ""
    remedy: str = ""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List what is attached, which driver claims it, why it cannot be opened, and the command that mends it. "
        "Nothing is opened, so a device in use is not disturbed."
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rig", help="rig whose library or firmware file counts for the devices of its driver")


def run(args: argparse.Namespace) -> int:
    rig = None if args.rig is None else load_rig(args.rig).device
    found = []
    for device in discovery.attached():
        claim = claim_on(device)
        found.append((device, claim, diagnose(device, claim, rig)))
    if args.json:
        print(json.dumps({"usb": discovery.has_usb(), "devices": [as_map(*one) for one in found]}, indent=2))
    else:
        print("\n".join(lines(found)))
    return 0


def diagnose(device: Attached, claim: Claim | None, rig: DeviceConfig | None = None) -> Diagnosis:
    """Why a device cannot be opened by its driver; the first reason of those that have to be mended in turn.

    rig  names the files that its driver needs
    """
    if claim is None:
        if device.bus == "hid":
            return Diagnosis("unclaimed", "no driver knows it", "if it is a haptic device, describe it: docs/hid.md")
        return Diagnosis("unclaimed", "no driver knows it")
    if claim.driver not in registry.names():
        return Diagnosis("driver", f"its driver '{claim.driver}' is not in this installation")
    if device.bus == "usb" and claim.bus in MODULES:
        node, module = MODULES[claim.bus]
        return Diagnosis("node", f"the system gives it no {node}", f"sudo modprobe {module}, and plug it in again")
    if not os.path.exists(device.node):
        return Diagnosis(
            "node",
            f"{device.node or 'its node'} is not there, as in a container that was not given it",
            f"docker run --device {device.node or '/dev/bus/usb'} ..., or run outside of the container",
        )
    if not discovery.permitted(device.node):
        return Diagnosis("permission", f"this user may not write to {device.node}", how_to_permit(device, claim))
    if (holder := discovery.holder(device.node)) is not None:
        return Diagnosis("busy", f"{device.node} is held by {holder}", f"kill {holder.pid}")
    return needs(claim, rig.options if rig is not None and rig.driver == claim.driver else {})


def needs(claim: Claim, options: Mapping[str, Any]) -> Diagnosis:
    """What a driver needs besides the device, with the options of a rig for it."""
    if claim.driver == "forcedimension":
        from softfinger.drivers.forcedimension import library

        try:
            library.load(options.get("library_file"))
        except HapticError as error:
            return Diagnosis("library", str(error), f"export FDSDK=/path/to/sdk   # from {library.DOWNLOAD}")
    if claim.driver == "falcon" and not Path(firmware := options.get("firmware", "")).is_file():
        named = f"'{firmware}' is no file" if firmware else "no rig named one (--rig)"
        return Diagnosis(
            "firmware",
            f"it needs its firmware after every power-up, which does not come with this program, and {named}",
            'firmware = "/path/to/firmware.bin" under [device] of the rig',
        )
    return Diagnosis("usable")


def how_to_permit(device: Attached, claim: Claim) -> str:
    """The command that lets this user open a node: a group that has the right already, else a udev rule."""
    if (group := discovery.group_with_access(device.node)) is not None:
        return f"sudo usermod -aG {group} $USER   # then log in again"
    if claim.bus == "hid":
        rule, file = discovery.hid_rule(device.vendor, device.product), discovery.HID_RULE_FILE
    elif claim.bus == "serial":
        rule, file = discovery.serial_rule(device.vendor, device.product), discovery.SERIAL_RULE_FILE
    else:
        usb = importlib.import_module(f"{registry.BUILT_IN[claim.driver]}.usb")  # where a driver over USB has its own
        rule, file = usb.RULE, usb.RULE_FILE
    return f"echo '{rule}' | sudo tee -a {file} && {discovery.RELOAD}"


def as_map(device: Attached, claim: Claim | None, diagnosis: Diagnosis) -> dict[str, object]:
    """One device for `--json`."""
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
    }


def lines(found: list[tuple[Attached, Claim | None, Diagnosis]]) -> list[str]:
    """The same for people: what a driver claims first, then the rest."""
    text = []
    for device, claim, diagnosis in sorted(found, key=lambda one: one[1] is None):
        text.append(f"{device.node or 'no node'}  {device.ids}  {device.name}")
        if claim is None:
            hint = f": {diagnosis.remedy}" if diagnosis.remedy else ""
            text.append(f"    {diagnosis.reason}{hint}")
            continue
        command = " or ".join(f"--rig {name}" for name in claim.rigs) or f"--device {claim.driver}"
        text.append(f"    driver {claim.driver}: softfinger run {command}")
        text.append(f"    {diagnosis.state}{': ' if diagnosis.reason else ''}{diagnosis.reason}")
        if diagnosis.remedy:
            text.append(f"    mend it: {diagnosis.remedy}")
    if not any(claim for _, claim, _ in found):
        where = "no device that a driver knows is attached" if found else "no USB or HID device is attached"
        bus = "" if discovery.has_usb() else f"; this system has no USB bus ({Path('/') / discovery.USB} is not there)"
        text.append(f"{where}{bus}. Without hardware: softfinger run, or softfinger run --rig simulated")
    return text
