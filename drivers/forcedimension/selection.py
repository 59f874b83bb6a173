"""Limits of each device, selection of the attached device that a rig describes, and diagnosis if none can be opened.

Type numbers: from the maker's header, and additional ones that CHAI3D's driver accepts. Limits: the recommended maxima
in that driver for omega, delta.3, sigma.7 and lambda.7. The other sigma and lambda models are assumed to have the
limits of their .7.
"""

from __future__ import annotations

import ctypes
import logging
import os
from functools import partial
from typing import Final, NamedTuple, NoReturn

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission, DeviceTimeout
from softfinger.drivers.base import ModelLimits
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.forcedimension import library
from softfinger.drivers.forcedimension.options import Options
from softfinger.drivers.system import discovery, rules
from softfinger.drivers.system.discovery import SystemDevice


class Model(NamedTuple):
    """Name in a rig, name with the hand it is made for, and limits."""

    name: str
    full_name: str
    limits: ModelLimits


OMEGA: Final = ModelLimits(12.0, 0.0, 5000.0, 30.0, 0.075)
DELTA: Final = ModelLimits(20.0, 0.0, 5000.0, 30.0, 0.15)
SIGMA_3: Final = ModelLimits(12.0, 0.0, 4000.0, 30.0, 0.075)
SIGMA_7: Final = SIGMA_3._replace(torque_max_nm=0.2)
LAMBDA_3: Final = ModelLimits(12.0, 0.0, 8000.0, 30.0, 0.1125)
LAMBDA_7: Final = LAMBDA_3._replace(torque_max_nm=0.2)
UNKNOWN: Final = ModelLimits(8.0, 0.0, 3000.0, 20.0, 0.04)
"""Limits for unlisted numbers: the lowest in CHAI3D for a device of this library (its Falcon), without torque."""

_SIGMA_6_RIGHT, _SIGMA_6_LEFT = (Model("sigma.6", f"sigma.6 {hand}", SIGMA_7) for hand in ("right", "left"))
_SIGMA_7_RIGHT, _SIGMA_7_LEFT = (Model("sigma.7", f"sigma.7 {hand}", SIGMA_7) for hand in ("right", "left"))
_LAMBDA_7_RIGHT, _LAMBDA_7_LEFT = (Model("lambda.7", f"lambda.7 {hand}", LAMBDA_7) for hand in ("right", "left"))

MODELS: Final = {
    33: Model("omega.3", "omega.3", OMEGA),
    34: Model("omega.6", "omega.6 right", OMEGA),
    36: Model("omega.6", "omega.6 left", OMEGA),
    35: Model("omega.7", "omega.7 right", OMEGA),
    37: Model("omega.7", "omega.7 left", OMEGA),
    63: Model("delta.3", "delta.3", DELTA),
    206: Model("sigma.3", "sigma.3", SIGMA_3),
    104: _SIGMA_7_RIGHT,
    105: _SIGMA_7_LEFT,
    203: Model("lambda.3", "lambda.3", LAMBDA_3),
    131: Model("lambda.6", "lambda.6 right", LAMBDA_3),
    132: Model("lambda.6", "lambda.6 left", LAMBDA_3),
    108: _LAMBDA_7_RIGHT,
    109: _LAMBDA_7_LEFT,
    # Only in CHAI3D's driver.
    110: Model("omega.3", "omega.3", OMEGA),
    111: Model("delta.3", "delta.3", DELTA),
    133: Model("sigma.3", "sigma.3", SIGMA_3),
    115: _SIGMA_6_RIGHT,
    116: _SIGMA_6_LEFT,
    **dict.fromkeys((102, 209), _SIGMA_7_RIGHT),
    103: _SIGMA_7_LEFT,
    **dict.fromkeys((112, 114, 117, 119, 121, 123, 125, 127, 129, 210), _LAMBDA_7_RIGHT),
    **dict.fromkeys((113, 118, 120, 122, 124, 126, 128, 130, 211), _LAMBDA_7_LEFT),
}
"""Models by `dhdGetSystemType`."""


VENDOR: Final = 0x1451
PRODUCTS: Final = {0x0402: "omega.x haptic device", 0x0301: "omega.x", 0x040C: "lambda"}
"""Names of known product numbers; every device of the vendor is listed."""

log: Final = logging.getLogger(__name__)


def list_attached() -> list[SystemDevice]:
    """Return every device of the vendor."""
    return [
        device._replace(name=PRODUCTS.get(device.product, "device of Force Dimension"))
        for device in discovery.iter_usb_devices()
        if device.vendor == VENDOR
    ]


def explain_refusal(device: SystemDevice) -> str:
    """Return the message for a device that this user may not write to; "" if it may, or if there is no node."""
    if not os.path.exists(device.node) or discovery.is_permitted(device.node):
        return ""
    return f"{device} may not be opened by this user: {rules.explain_permission(VENDOR, 0)}"


def open_selected(call: ctypes.CDLL, options: Options) -> tuple[int, Model]:
    """Open the device that the options select, or the first that opens; return its ID and model."""
    count = call.dhdGetDeviceCount()
    if count <= 0:
        _raise_not_found(call, count)
    numbers = range(count) if options.number is None else [options.number]
    rejected: list[str] = []
    failed: DeviceError | None = None
    for number in numbers:
        device = call.drdOpenID(number)
        if device < 0:
            failed = failed or _make_open_error(call, number)
            continue
        with undo_on_error(partial(call.drdClose, device)):
            kind, serial = call.dhdGetSystemType(device), read_serial(call, device)
            model = MODELS.get(kind) or Model("", f"device of unknown type {kind}", UNKNOWN)
            if options.serial in (None, serial) and options.model in (None, model.name):
                return device, model
        rejected.append(f"{model.full_name}, serial {serial}")
        call.drdClose(device)
    if failed is not None:
        raise failed
    criteria = {"model": options.model, "serial": options.serial, "number": options.number}
    criteria_text = ", ".join(f"{key} = {value}" for key, value in criteria.items() if value is not None)
    raise DeviceNotFound(
        f"no device matches {criteria_text or 'this driver'}: attached are {'; '.join(rejected)}: "
        "change [device] in the rig, or attach the device"
    )


def load(file: str | None) -> ctypes.CDLL:
    """Load the library; if it is missing, the error also lists devices attached over USB."""
    try:
        loaded = library.load(file)
    except DeviceNotFound as error:
        devices = [explain_refusal(device) or str(device) for device in list_attached()]
        attached = f". Attached over USB: {'; '.join(devices)}" if devices else ""
        raise DeviceNotFound(f"{error}{attached}") from None
    parts = [ctypes.c_int() for _ in range(4)]
    loaded.dhdGetSDKVersion(*map(ctypes.byref, parts))
    log.info("Force Dimension's library, version %s", ".".join(str(part.value) for part in parts))
    return loaded


def read_serial(call: ctypes.CDLL, device: int) -> int:
    serial = ctypes.c_ushort()
    if call.dhdGetSerialNumber(ctypes.byref(serial), device) < 0:
        raise DeviceError(
            f"serial number: {library.format_error(call)}: switch the device off and on, then start again"
        )
    return serial.value


def _raise_not_found(call: ctypes.CDLL, count: int) -> NoReturn:
    devices = list_attached()
    for device in devices:
        if message := explain_refusal(device):
            raise DevicePermission(message)
    if count < 0:
        raise DeviceError(f"the devices cannot be counted: {library.format_error(call)}: check cable and power")
    if devices:
        raise DeviceError(f"the library does not see {devices[0]}: switch the device on, or off and on again")
    raise DeviceNotFound("no device of Force Dimension is attached: check cable and power (USB vendor 1451)")


def _make_open_error(call: ctypes.CDLL, number: int) -> DeviceError:
    code, text = call.dhdErrorGetLast(), library.format_error(call)
    if code in (library.ERROR_BUSY, library.ERROR_IN_USE):
        holders = [str(holder) for device in list_attached() if (holder := discovery.find_holder(device.node))]
        by = ", ".join(holders) or "another process"
        return DeviceBusy(f"device {number} is used by {by} ({text}): end that process, then start again")
    if code == library.ERROR_NO_DEVICE:
        return DeviceNotFound(f"device {number} is no longer attached ({text}): check cable and power")
    if code in (library.ERROR_COM, library.ERROR_NO_DRIVER):
        for device in list_attached():
            if message := explain_refusal(device):
                return DevicePermission(message)
    if code == library.ERROR_TIMEOUT:
        return DeviceTimeout(f"device {number} did not answer when opened ({text}): switch it off and on")
    return DeviceError(f"device {number} cannot be opened: {text}: check cable and power, then start again")
