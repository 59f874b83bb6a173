"""Checks of the access to devices on this machine: libraries, makers' libraries, and attached devices."""

from __future__ import annotations

import importlib
from typing import Final

from softfinger.config.errors import HapticError
from softfinger.config.schema import Rig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.system import discovery
from softfinger.drivers.system import libusb as system_libusb
from softfinger.drivers.system.claims import Claim, find_claim, list_claims, matches_device
from softfinger.drivers.system.diagnosis import LIBRARY_DRIVERS, diagnose, find_makers_library
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.tools.doctor.machine import STATES, Check, State

OVER_USB: Final = ("falcon", "forcedimension")
OVER_HID: Final = ("hid", "spacemouse")


def list_checks(rig: Rig) -> list[Check]:
    results = [check_libusb(rig), check_hidapi(rig), *(check_maker_library(rig, driver) for driver in LIBRARY_DRIVERS)]
    if find_single_device(rig).driver == "haply":
        results.append(check_inverse_service(rig))
    return [*results, *check_devices(rig, discovery.list_attached())]


def _grade_missing(needed: bool) -> State:
    return STATES[1 + needed]


def check_libusb(rig: Rig) -> Check:
    origin = system_libusb.find_origin()
    return Check(
        "libusb",
        "good" if origin else _grade_missing(find_single_device(rig).driver in OVER_USB),
        f"found, {origin}" if origin else "not found",
        "there, for a Falcon",
        system_libusb.REMEDY,
    )


def check_hidapi(rig: Rig) -> Check:
    missing = []
    for name in ("hid", "hidraw"):
        try:
            importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{name} cannot be imported: {error}")
    return Check(
        "hidapi",
        _grade_missing(find_single_device(rig).driver in OVER_HID) if missing else "good",
        "; ".join(missing) or "modules hid and hidraw found",
        "both modules, for HID devices",
        "pip install --force-reinstall hidapi, and apt install libusb-1.0-0 libudev1",
    )


def check_maker_library(rig: Rig, driver: str) -> Check:
    """Check a maker's library, which is not part of this program; only its devices need it."""
    library = find_makers_library(driver)
    needed = find_single_device(rig).driver == driver
    expected = "found, for the maker's devices"
    try:
        library.load(find_single_device(rig).options.get("library_file") if needed else None)
    except HapticError as error:
        if not needed:
            return Check(library.NAME, "good", "not found; this rig does not need it", expected)
        return Check(library.NAME, "bad", str(error), expected, library.REMEDY)
    return Check(library.NAME, "good", "found", expected)


def check_inverse_service(rig: Rig) -> Check:
    """Check Haply's service, which owns the devices: query its list, without sending anything to a device."""
    from softfinger.drivers.haply import connection, link

    options = find_single_device(rig).options
    try:
        reply = connection.identify(options.get("port", connection.DEFAULT_PORT), options.get("version"))
    except HapticError as error:
        return Check("Inverse Service", "bad", str(error), "running", link.START)
    state: State = "good" if reply["devices"] else "bad"
    observation = f"version {reply['service']}, lists {', '.join(reply['devices'] + reply['grips']) or 'no device'}"
    return Check("Inverse Service", state, observation, "running, with a device", "plug the device in and switch it on")


def check_devices(rig: Rig, attached: list[SystemDevice]) -> list[Check]:
    """Check each device that a driver claims, as `devices` diagnoses it; bad if the rig needs it and it is unusable."""
    driver, expected = find_single_device(rig).driver, "usable"
    results, is_attached = [], False
    for device in attached:
        claim, is_of_rig = find_claim(device), is_of(rig, device)
        if claim is None and is_of_rig:  # only the rig describes it, no shipped rig does
            claim = Claim(driver, device.bus, device.vendor, device.product)
        if claim is None:
            continue
        is_attached = is_attached or is_of_rig
        diagnosis = diagnose(device, claim, find_single_device(rig))
        state: State = "good" if diagnosis.state == "usable" else _grade_missing(is_of_rig)
        reason = f": {diagnosis.reason}" if diagnosis.reason else ""
        results.append(
            Check(
                f"device {device.ids}", state, f"{device.name}: {diagnosis.state}{reason}", expected, diagnosis.remedy
            )
        )
    if not is_attached and driver != "haply" and driver in {claim.driver for claim in list_claims()}:
        remedy = "plug it in and switch it on; softfinger devices lists what is attached"
        results.append(
            Check("device of the rig", "bad", f"no device for driver {driver} of this rig", "attached", remedy)
        )
    if not results:
        results.append(
            Check("devices", "good", "no supported device is attached; the rig needs none", "what the rig needs")
        )
    return results


def is_of(rig: Rig, device: SystemDevice) -> bool:
    """Return whether a device may be the rig's: by its ids or path if the rig gives them, else by its driver."""
    options, claim = find_single_device(rig).options, find_claim(device)
    if "vendor_id" in options:
        return matches_device(device, options)
    if options.get("path") is not None:
        return bool(device.node == options["path"])
    return claim is not None and claim.driver == find_single_device(rig).driver
