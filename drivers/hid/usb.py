"""HID device on the USB bus without a hidraw node, through hidapi's libusb backend.

The backend detaches the interface from the system's HID driver and attaches it again when closed. Its errors have no
cause, so the node on the bus is opened and locked first, which reports one.
"""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound
from softfinger.drivers.hid.descriptor import check_reports, has_reports
from softfinger.drivers.hid.options import Options
from softfinger.drivers.hid.report_threads import HidApi
from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.drivers.system.hidraw import import_hidapi, read_ids
from softfinger.drivers.system.nodes import open_locked
from softfinger.drivers.system.rules import explain_permission


class OpenInterface(NamedTuple):
    """Device in hidapi, and a file descriptor that is locked against other programs."""

    device: HidApi
    lock_fd: int


def list_attached(vendor: int, product: int) -> dict[str, str]:
    """Return the serial numbers of HID interfaces with these ids, by hidapi's path.

    A path such as 1-2.3:1.0 contains bus, ports and interface.
    """
    matching: list[dict[str, Any]] = import_hidapi("hid").enumerate(vendor, product)
    serials = {os.fsdecode(entry["path"]): entry["serial_number"] or "" for entry in matching}
    # hidapi needs permission to open a device for its serial number; the system's table is readable by all users
    return {
        path: device_entry.serial if (device_entry := _find_device(path)) else serial
        for path, serial in serials.items()
    }


def open_usb(path: str, options: Options) -> OpenInterface:
    """Open the interface at hidapi's `path`, and claim it for this process.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is another device, or has other reports
    than the rig.
    """
    interface, descriptor = _open(path, options)
    try:
        check_reports(descriptor, path, options.reports)
    except BaseException:
        _close(interface)
        raise
    return interface


def with_reports_of(paths: list[str], options: Options) -> list[str]:
    """Return the interfaces of a device that have the rig's reports: opens, reads and closes each.

    Raises the errors of `open_usb`, except for other reports.
    """
    matching = []
    for path in paths:
        interface, descriptor = _open(path, options)
        _close(interface)
        if has_reports(descriptor, options.reports):
            matching.append(path)
    return matching


def _close(interface: OpenInterface) -> None:
    interface.device.close()
    os.close(interface.lock_fd)


def _open(path: str, options: Options) -> tuple[OpenInterface, bytes]:
    """Return the opened interface at `path`, and its report descriptor."""
    vendor, product = options.vendor_id, options.product_id
    device_entry = _find_device(path)
    if device_entry is None:
        raise DeviceNotFound(f"there is no USB device at {path}: plug it in, or remove `path`")
    if (device_entry.vendor, device_entry.product) != (vendor, product):
        raise DeviceError(
            f"{path} is the device {device_entry.ids}, but the rig is for {read_ids(vendor, product)}: "
            "set path to the right one, or remove it"
        )
    lock_fd = open_locked(device_entry.node, explain_permission(vendor, product))
    device: Any = import_hidapi("hid").device()
    try:
        try:
            device.open_path(os.fsencode(path))
        except OSError as error:
            raise _open_error(path, device_entry.node) from error
        try:
            descriptor = bytes(device.get_report_descriptor())
        except OSError as error:
            raise DeviceError(
                f"{path} does not return its report descriptor: unplug it and plug it in again"
            ) from error
    except BaseException:
        device.close()
        os.close(lock_fd)
        raise
    return OpenInterface(device, lock_fd), descriptor


def _find_device(path: str) -> SystemDevice | None:
    """Return the device of an interface: hidapi's path starts with the system's name for it."""
    return discovery.read_device(str(discovery.USB / path.partition(":")[0]))


def _open_error(path: str, node: str) -> DeviceError:
    """Return the error for an unopened interface: hidapi gives no cause, so find the process that has claimed it."""
    program = discovery.find_holder(node)
    if program is not None and program.pid != os.getpid():
        return DeviceBusy(f"{path} ({node}) is used by {program}: end that process first")
    return DeviceError(
        f"{path} ({node}) cannot be claimed through hidapi: another program may use it: end it, or unplug the "
        "device and plug it in again"
    )
