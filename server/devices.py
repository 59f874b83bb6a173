"""`devices`: what is attached, which driver claims it, why it cannot be opened, and the command that mends it."""

from __future__ import annotations

import argparse
import importlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.errors import DeviceBusy, HapticError
from softfinger.config.load import build, load_rig
from softfinger.config.schema import DeviceConfig
from softfinger.drivers import discovery, registry
from softfinger.drivers.claims import Claim, claim_on
from softfinger.drivers.discovery import Attached

MODULES: Final = {"hid": ("hidraw node", "usbhid"), "serial": ("serial port", "cdc_acm")}
"""What the system gives a device of a bus, and the module of the kernel that makes it."""
MAY_BE_ASKED: Final = ("usable", "firmware")
"""States in which a device can be opened; whether firmware runs in a Falcon, only it knows."""


class Diagnosis(NamedTuple):
    """Whether a device can be used, in a word; if not, why and what to do.

    state   usable, unclaimed, or what is in the way: driver, node, permission, busy, library, firmware; error, where
            a device that was asked failed
    """

    state: str
    reason: str = ""
    remedy: str = ""


Found = tuple[Attached, Claim | None, Diagnosis, Mapping[str, Any] | None]
"""A device, who claims it, what is in the way, and what it said itself."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List what is attached, which driver claims it, why it cannot be opened, and the command that mends it. "
        "Nothing is opened, so a device in use is not disturbed, unless --ask is given."
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--ask", action="store_true", help="open each device that is free, and ask what only it knows")
    parser.add_argument("--rig", help="rig whose library or firmware file counts for the devices of its driver")


def run(args: argparse.Namespace) -> int:
    rig = None if args.rig is None else load_rig(args.rig).device
    found: list[Found] = []
    for device in discovery.attached():
        claim = claim_on(device)
        diagnosis, said = diagnose(device, claim, rig), None
        if args.ask and claim is not None and diagnosis.state in MAY_BE_ASKED:
            diagnosis, said = ask(device, claim, rig)
        found.append((device, claim, diagnosis, said))
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
    bare = device.bus == "usb" and claim.bus in MODULES
    if bare and claim.driver != "hid":
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
    if bare:
        return Diagnosis("usable", "the system gives it no hidraw node, so threads carry its reports over libusb")
    return needs(claim, options_for(claim, rig))


def ask(device: Attached, claim: Claim, rig: DeviceConfig | None = None) -> tuple[Diagnosis, dict[str, Any] | None]:
    """Open a device that is free and ask it; what is in the way then, and its answers by name.

    The answers are None where its driver has nothing to ask, or the device could not be opened.
    """
    driver, options = registry.load(claim.driver), options_for(claim, rig)
    identify = getattr(driver, "identify", None)
    if identify is None:
        return needs(claim, options), None
    try:
        said = identify(device, build(driver.Options, dict(options), "[device]"))
    except HapticError as error:
        return Diagnosis("busy" if isinstance(error, DeviceBusy) else "error", str(error)), None
    return needs(claim, options, said), said


def options_for(claim: Claim, rig: DeviceConfig | None) -> Mapping[str, Any]:
    """What a rig says of a device; another driver's rig has no say."""
    return rig.options if rig is not None and rig.driver == claim.driver else {}


def needs(claim: Claim, options: Mapping[str, Any], said: Mapping[str, Any] | None = None) -> Diagnosis:
    """What a driver needs besides the device, with the options of a rig for it and what the device said itself."""
    if claim.driver == "forcedimension":
        from softfinger.drivers.forcedimension import library

        try:
            library.load(options.get("library_file"))
        except HapticError as error:
            return Diagnosis("library", str(error), f"export FDSDK=/path/to/sdk   # from {library.DOWNLOAD}")
    loaded = said is not None and said.get("firmware", False)
    if claim.driver == "falcon" and not loaded and not Path(firmware := options.get("firmware", "")).is_file():
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
    if device.bus == "hid":
        rule, file = discovery.hid_rule(device.vendor, device.product), discovery.HID_RULE_FILE
    elif claim.bus == "serial":
        rule, file = discovery.serial_rule(device.vendor, device.product), discovery.SERIAL_RULE_FILE
    elif claim.bus == "hid":
        rule, file = discovery.usb_rule(device.vendor, device.product), discovery.HID_RULE_FILE
    else:
        usb = importlib.import_module(f"{registry.BUILT_IN[claim.driver]}.usb")  # where a driver over USB has its own
        rule, file = usb.RULE, usb.RULE_FILE
    return f"echo '{rule}' | sudo tee -a {file} && {discovery.RELOAD}"


def as_map(
    device: Attached, claim: Claim | None, diagnosis: Diagnosis, said: Mapping[str, Any] | None = None
) -> dict[str, object]:
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
        "said": said,
    }


def lines(found: list[Found]) -> list[str]:
    """The same for people: what a driver claims first, then the rest."""
    text = []
    for device, claim, diagnosis, said in sorted(found, key=lambda one: one[1] is None):
        text.append(f"{device.node or 'no node'}  {device.ids}  {device.name}")
        if claim is None:
            hint = f": {diagnosis.remedy}" if diagnosis.remedy else ""
            text.append(f"    {diagnosis.reason}{hint}")
            continue
        command = " or ".join(f"--rig {name}" for name in claim.rigs) or f"--device {claim.driver}"
        text.append(f"    driver {claim.driver}: softfinger run {command}")
        text.append(f"    {diagnosis.state}{': ' if diagnosis.reason else ''}{diagnosis.reason}")
        if said is not None:
            text.append(f"    it says: {', '.join(f'{name} {value}' for name, value in said.items())}")
        if diagnosis.remedy:
            text.append(f"    mend it: {diagnosis.remedy}")
    if not any(claim for _, claim, *_ in found):
        where = "no device that a driver knows is attached" if found else "no USB or HID device is attached"
        bus = "" if discovery.has_usb() else f"; this system has no USB bus ({Path('/') / discovery.USB} is not there)"
        text.append(f"{where}{bus}. Without hardware: softfinger run, or softfinger run --rig simulated")
    return text
