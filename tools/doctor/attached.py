"""Checks of the access to devices on this machine: libraries, makers' libraries, and attached devices."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import Any, Final

from softfinger.config.errors import HapticError
from softfinger.config.schema import DeviceConfig, Rig
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
    if (options := _find_options(rig, "haply")) is not None:
        results.append(check_inverse_service(options))
    return [*results, *check_devices(rig, discovery.list_attached())]


def _grade_missing(needed: bool) -> State:
    return STATES[1 + needed]


def _needs(rig: Rig, drivers: Sequence[str]) -> bool:
    return any(config.driver in drivers for config in rig.tables.values())


def _find_options(rig: Rig, driver: str) -> dict[str, Any] | None:
    """Return the options of the rig's first device with this driver; None if there is none."""
    return next((config.options for config in rig.tables.values() if config.driver == driver), None)


def check_libusb(rig: Rig) -> Check:
    origin = system_libusb.find_origin()
    return Check(
        "libusb",
        "good" if origin else _grade_missing(_needs(rig, OVER_USB)),
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
        _grade_missing(_needs(rig, OVER_HID)) if missing else "good",
        "; ".join(missing) or "modules hid and hidraw found",
        "both modules, for HID devices",
        "pip install --force-reinstall hidapi, and apt install libusb-1.0-0 libudev1",
    )


def check_maker_library(rig: Rig, driver: str) -> Check:
    """Check a maker's library, which is not part of this program; only its devices need it."""
    library = find_makers_library(driver)
    options = _find_options(rig, driver)
    expected = "found, for the maker's devices"
    try:
        library.load(None if options is None else options.get("library_file"))
    except HapticError as error:
        if options is None:
            return Check(library.NAME, "good", "not found; this rig does not need it", expected)
        return Check(library.NAME, "bad", str(error), expected, library.REMEDY)
    return Check(library.NAME, "good", "found", expected)


def check_inverse_service(options: dict[str, Any]) -> Check:
    """Check Haply's service, which owns the devices: query its list, without sending anything to a device."""
    from softfinger.drivers.haply import connection, link
    from softfinger.drivers.haply.options import DEFAULT_PORT

    try:
        reply = connection.identify(options.get("port", DEFAULT_PORT), options.get("version"))
    except HapticError as error:
        return Check("Inverse Service", "bad", str(error), "running", link.START)
    state: State = "good" if reply["devices"] else "bad"
    observation = f"version {reply['service']}, lists {', '.join(reply['devices'] + reply['grips']) or 'no device'}"
    return Check("Inverse Service", state, observation, "running, with a device", "plug the device in and switch it on")


def check_devices(rig: Rig, attached: Sequence[SystemDevice]) -> list[Check]:
    """Check each device that a driver claims, as `devices` diagnoses it; bad if the rig needs it and it is unusable."""
    configs = list(rig.tables.values())
    ports = [SystemDevice("serial", 0, 0, "port", "", path) for path in map(_find_other_port, configs) if path]
    attached = [
        *attached,
        *(port for port in ports if not any(discovery.is_same_node(port.node, other.node) for other in attached)),
    ]
    results = []
    for device in attached:
        claim, config = find_claim(device), next((config for config in configs if is_of(config, device)), None)
        if claim is None and config is not None:  # only the rig describes it, no shipped rig does
            claim = Claim(config.driver, device.bus, device.vendor, device.product)
        if claim is None:
            continue
        diagnosis = diagnose(device, claim, config)
        state: State = "good" if diagnosis.state == "usable" else _grade_missing(config is not None)
        reason = f": {diagnosis.reason}" if diagnosis.reason else ""
        seen = f"{device.name}: {diagnosis.state}{reason}"
        results.append(
            Check(f"device {device.ids if device.vendor else device.node}", state, seen, "usable", diagnosis.remedy)
        )
    for table, config in rig.tables.items():
        if (
            not any(is_of(config, device) for device in attached)
            and (check := _check_absent(table, config)) is not None
        ):
            results.append(check)
    if not results:
        results.append(
            Check("devices", "good", "no supported device is attached; the rig needs none", "what the rig needs")
        )
    return results


def _check_absent(table: str, config: DeviceConfig) -> Check | None:
    """Return the check of a device that the system does not list; None for a driver whose devices are not listed."""
    if config.driver == "haply" or config.driver not in {claim.driver for claim in list_claims()}:
        return None
    remedy = "plug it in and switch it on; softfinger devices lists what is attached"
    name = "device of the rig" if table == "device" else f"device of [{table}]"
    if config.driver == "openhaptics":
        seen = "no device of 3D Systems on USB; a device with Ethernet or FireWire is not listed"
        return Check(name, "could be better", seen, "attached", f"{remedy}, with --ask --rig also this one")
    place = f" at {config.options['path']}" if "path" in config.options else ""
    return Check(name, "bad", f"no device for driver {config.driver} of this rig{place}", "attached", remedy)


def _find_other_port(config: DeviceConfig) -> str:
    """Return the path of an existing port that may not be on USB, such as /dev/ttyS0; empty if the rig sets none."""
    path = config.options.get("path") if config.driver == "serial" else None
    return path if isinstance(path, str) and os.path.exists(path) else ""


def is_of(config: DeviceConfig, device: SystemDevice) -> bool:
    """Return whether a device may be that of a rig: by path, serial number or ids if the rig sets them, else driver."""
    options, claim = config.options, find_claim(device)
    if str(options.get("path", "")).startswith("/"):
        return discovery.is_same_node(options["path"], device.node)
    if isinstance(serial := options.get("serial"), str) and serial != device.serial:
        return False
    if "vendor_id" in options:
        return matches_device(device, options)
    if options.get("path") is not None:
        return bool(device.node == options["path"])
    return claim is not None and claim.driver == config.driver
