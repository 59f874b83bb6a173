"""Diagnosis why the driver of an attached device cannot open it, and the command that repairs it. Nothing is opened."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from softfinger.config.errors import HapticError
from softfinger.config.schema import DeviceConfig
from softfinger.drivers import registry
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import Claim, explain_ambiguity, find_claims
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.drivers.system.rules import install_command

MODULES: Final = {"hid": ("hidraw node", "usbhid"), "serial": ("serial port", "cdc_acm")}
"""Node that the system creates for a device of a bus, and the kernel module for it."""


LIBRARY_DRIVERS: Final = ("forcedimension", "openhaptics")
"""Drivers that need a maker's library, which this program does not include."""


class Diagnosis(NamedTuple):
    """State of a device: usable or not, with reason and remedy.

    state   usable, unclaimed, error (communication with the device failed), or the obstacle: driver, node, permission,
            busy, product, library, service, firmware
    """

    state: str
    reason: str = ""
    remedy: str = ""


def diagnose(device: SystemDevice, claim: Claim | None, rig: DeviceConfig | None = None) -> Diagnosis:
    """Return the first obstacle to opening a device with its driver; they have to be removed in this order.

    rig  configures files that the driver needs
    """
    if claim is None:
        if device.bus == "hid" and find_claims(device):
            return Diagnosis(
                "unclaimed",
                "no rig with these ids has its reports: it may be another channel of a board, or have other firmware",
            )
        if device.bus == "hid":
            return Diagnosis(
                "unclaimed", "no driver knows it", "if it is a haptic device, describe its reports: docs/devices/hid.md"
            )
        if device.bus == "serial":
            return Diagnosis(
                "unclaimed",
                "no driver supports its ids",
                "if it is a Hapkit, a Haply 2DIY or another board, set this port: docs/devices/serial.md",
            )
        return Diagnosis("unclaimed", "no driver knows it")
    if claim.driver not in registry.list_names():
        return Diagnosis("driver", f"its driver '{claim.driver}' is not installed")
    if claim.driver == "haply":  # the service has the port open all the time
        return diagnose_requirements(claim, read_options(claim, rig))
    has_no_node = device.bus == "usb" and claim.bus in MODULES
    if has_no_node and claim.driver != "hid":
        node, module = MODULES[claim.bus]
        return Diagnosis(
            "node", f"the system provides no {node} for it", f"sudo modprobe {module}, and plug it in again"
        )
    if not os.path.exists(device.node):
        return Diagnosis(
            "node",
            f"{device.node or 'its node'} does not exist; in a container it must be passed on",
            f"docker run --device {device.node or '/dev/bus/usb'} ..., or run outside of the container",
        )
    if not discovery.is_permitted(device.node):
        return Diagnosis("permission", f"this user may not write to {device.node}", suggest_permission_command(device))
    if (holder := discovery.find_holder(device.node)) is not None:
        return Diagnosis("busy", f"{device.node} is used by {holder}", f"kill {holder.pid}")
    if has_no_node:
        return Diagnosis(
            "usable", "the system provides no hidraw node for it, so threads transfer its reports through libusb"
        )
    options = read_options(claim, rig)
    is_path = discovery.is_same_node(options.get("path", ""), device.node)
    is_named = is_path or options.get("serial") == device.serial != ""
    if not is_named and (why := explain_ambiguity(device)) is not None:
        ask = "; a Haply device may appear so: softfinger devices --ask --rig haply-inverse3 queries its service"
        return Diagnosis(
            "product", why, f'if it is the right one: path = "{device.node}" under [device] of the rig{ask}'
        )
    return diagnose_requirements(claim, options)


def find_makers_library(driver: str) -> Any:
    """Return the library module of a driver: NAME, `load(file)`, and REMEDY if it is missing."""
    return importlib.import_module(f"softfinger.drivers.{driver}.library")


def read_options(claim: Claim, rig: DeviceConfig | None) -> Mapping[str, Any]:
    """Return a rig's options for a device; empty for a rig of another driver."""
    return rig.options if rig is not None and rig.driver == claim.driver else {}


def diagnose_requirements(
    claim: Claim, options: Mapping[str, Any], answers: Mapping[str, Any] | None = None
) -> Diagnosis:
    """Return the diagnosis of a driver's other requirements, given a rig's options and the device's answers."""
    if claim.driver in LIBRARY_DRIVERS:
        library = find_makers_library(claim.driver)
        try:
            library.load(options.get("library_file"))
        except HapticError as error:
            return Diagnosis("library", str(error), library.REMEDY)
    if claim.driver == "haply" and answers is None:
        from softfinger.drivers.haply import connection, link
        from softfinger.drivers.haply.options import DEFAULT_PORT

        try:
            connection.identify(options.get("port", DEFAULT_PORT), options.get("version"))
        except HapticError as error:
            return Diagnosis("service", str(error), link.START)
    loaded = answers is not None and answers.get("firmware", False)
    if claim.driver == "falcon" and not loaded and not os.path.isfile(firmware := options.get("firmware", "")):
        is_named = f"'{firmware}' is not a file" if firmware else "no rig sets one (--rig)"
        return Diagnosis(
            "firmware",
            f"it needs its firmware after every power-up, which is not part of this program; {is_named}",
            'firmware = "/path/to/firmware.bin" under [device] of the rig',
        )
    return Diagnosis("usable")


def suggest_permission_command(device: SystemDevice) -> str:
    """Return the command that permits this user to open a node: membership of a group, else the udev rules."""
    if (group := discovery.find_group_with_access(device.node)) is not None:
        return f"sudo usermod -aG {group} $USER   # then log in again"
    return f"{install_command(device.vendor, device.product)}   # then plug the device in again"
