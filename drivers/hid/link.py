"""Selection and opening of a device, by its node or on the USB bus, and the path of its reports.

The loop exchanges reports with the node, or with two threads that use hidapi. On the USB bus without a node, hidapi's
libusb backend detaches the interface from the system's HID driver and attaches it again when closed. Its errors have no
cause, so the node on the bus is opened and locked first, which reports one.

The ids of a device do not identify it: boards with other programs share the ids of one vendor, and one board may have
several interfaces under its ids. So its report descriptor is compared with the reports of the rig.
"""

from __future__ import annotations

import fcntl
import os
import struct
from functools import partial
from typing import Any, Final, NamedTuple

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceLost, DeviceNotFound
from softfinger.drivers.base import IGNORED_WRENCH_MAX_S
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.hid import exchange
from softfinger.drivers.hid.options import Options, Reports
from softfinger.drivers.hid.report_threads import HidApi, ReportThreads
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import read_report_lengths
from softfinger.drivers.system.descriptor import ReportLengths, parse_descriptor
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.drivers.system.nodes import format_ids, import_hidapi, open_locked, open_path
from softfinger.drivers.system.rules import explain_permission


def make_report_lengths(reports: Reports) -> ReportLengths:
    return ReportLengths({reports.input.id: reports.input.bytes}, {reports.output.id: reports.output.bytes})


def has_reports(descriptor: bytes, reports: Reports) -> bool:
    """Return True if a descriptor announces the reports of a rig; also True for an unknown descriptor."""
    try:
        return not descriptor or parse_descriptor(descriptor).includes(make_report_lengths(reports))
    except ValueError:
        return True  # opening reports the damage


def check_reports(descriptor: bytes, path: str, reports: Reports) -> None:
    """Raise DeviceError, with both lists, if the device at `path` announces other reports than the rig describes."""
    try:
        announced = parse_descriptor(descriptor)
    except ValueError as error:
        raise DeviceError(f"{path}: its report descriptor is damaged: {error}") from error
    expected = make_report_lengths(reports)
    if announced.includes(expected):
        return
    matching_names = [name for name, lengths in read_report_lengths().items() if announced.includes(lengths)]
    hint = (
        f'set reports to "{matching_names[0]}", which has these reports'
        if matching_names
        else "correct [device.reports]"
    )
    raise DeviceError(
        f"{path} has different reports from the rig: the device reports {announced}; the rig describes {expected}: "
        f"{hint} (descriptor {descriptor.hex()})"
    )


class OpenInterface(NamedTuple):
    """Device in hidapi, a file descriptor that is locked against other programs, and the report descriptor."""

    device: HidApi
    lock_fd: int
    descriptor: bytes


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


def filter_by_reports(paths: list[str], options: Options) -> list[str]:
    """Return the interfaces in `paths` that announce the rig's reports. Opens, reads and closes each."""
    matching = []
    for path in paths:
        interface = open_usb(path, options)
        _close(interface)
        if has_reports(interface.descriptor, options.reports):
            matching.append(path)
    return matching


def _close(interface: OpenInterface) -> None:
    interface.device.close()
    os.close(interface.lock_fd)


def open_usb(path: str, options: Options) -> OpenInterface:
    """Open the interface at hidapi's `path`, and claim it for this process.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is another device.
    """
    vendor, product = options.vendor_id, options.product_id
    device_entry = _find_device(path)
    if device_entry is None:
        raise DeviceNotFound(f"there is no USB device at {path}: plug it in, or remove `path`")
    if (device_entry.vendor, device_entry.product) != (vendor, product):
        raise DeviceError(
            f"{path} is the device {device_entry.ids}, but the rig is for {format_ids(vendor, product)}: "
            "set path to the right one, or remove it"
        )
    lock_fd = open_locked(device_entry.node, explain_permission(vendor, product))
    device: Any = import_hidapi("hid").device()
    interface = OpenInterface(device, lock_fd, b"")
    with undo_on_error(partial(_close, interface)):
        try:
            device.open_path(os.fsencode(path))
        except OSError as error:
            raise _make_open_error(path, device_entry.node) from error
        try:
            descriptor = bytes(device.get_report_descriptor())
        except OSError as error:
            raise DeviceError(
                f"{path} does not return its report descriptor: unplug it and plug it in again"
            ) from error
    return interface._replace(descriptor=descriptor)


def _find_device(path: str) -> SystemDevice | None:
    """Return the device of an interface: hidapi's path starts with the system's name for it."""
    return discovery.read_device(str(discovery.USB / path.partition(":")[0]))


def _make_open_error(path: str, node: str) -> DeviceError:
    """Return the error for an unopened interface: hidapi gives no cause, so find the process that has claimed it."""
    program = discovery.find_holder(node)
    if program is not None and program.pid != os.getpid():
        return DeviceBusy(f"{path} ({node}) is used by {program}: end that process first")
    return DeviceError(
        f"{path} ({node}) cannot be claimed through hidapi: another program may use it: end it, or unplug the "
        "device and plug it in again"
    )


# Requests for ioctl, from <linux/hidraw.h>.
_GET_DESCRIPTOR_SIZE: Final = 0x80044801
_GET_DESCRIPTOR: Final = 0x90044802
_DESCRIPTOR_MAX: Final = 4096
USB_DESCRIPTORS_MAX: Final = 65536
USB_INTERFACE, USB_ENDPOINT = 4, 5
"""Types of descriptors: number and alternate setting, or address, follow."""


class ReportLink(NamedTuple):
    """File descriptor that the exchange reads and writes: a node, or with threads the socket that replaces it.

    node                 path of the device's node; empty on the USB bus without an endpoint for reports
    interface, endpoint  destination of reports on the USB bus; endpoint 0 on hidraw
    """

    fd: int
    threads: ReportThreads | None = None
    node: str = ""
    interface: int = 0
    endpoint: int = 0


def open_link(options: Options) -> ReportLink:
    """Find the device of a rig, and open its node or, with `through = "thread"` or without a node, hidapi.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, DeviceLost, or DeviceError if it is another device, or has
    other reports than the rig.
    """
    path = options.path or find_device(options)
    if not path.startswith("/"):
        opened = open_usb(path, options)
        with undo_on_error(partial(_close, opened)):
            check_reports(opened.descriptor, path, options.reports)
            interface = int(path.rpartition(".")[2])
            try:
                endpoint = find_output_endpoint(os.pread(opened.lock_fd, USB_DESCRIPTORS_MAX, 0), interface)
            except OSError as error:
                raise DeviceLost(f"{path} is gone ({error.strerror}): plug it in again") from error
        device_entry, link = _find_device(path), make_thread_link(opened.device, options, opened.lock_fd)
        if endpoint and device_entry is not None:
            return link._replace(node=device_entry.node, interface=interface, endpoint=endpoint)
        return link
    fd = open_path(path, options.vendor_id, options.product_id)
    with undo_on_error(partial(os.close, fd)):
        check_reports(_read_descriptor(fd, path), path, options.reports)
        device = _open_hidapi(path) if options.through == "thread" else None
    return ReportLink(fd, None, path) if device is None else make_thread_link(device, options, fd)._replace(node=path)


def find_output_endpoint(descriptors: bytes, interface: int) -> int:
    """Return the endpoint of an interface that receives its output reports; 0 if it has none."""
    at, is_in_interface = 0, False
    while at + 4 <= len(descriptors) and descriptors[at] >= 2:
        kind, number, value = descriptors[at + 1], descriptors[at + 2], descriptors[at + 3]
        if kind == USB_INTERFACE:
            is_in_interface = (number, value) == (interface, 0)
        elif kind == USB_ENDPOINT and is_in_interface and number < 0x80:
            return number
        at += descriptors[at]
    return 0


def make_thread_link(device: HidApi, options: Options, lock_fd: int | None = None) -> ReportLink:
    """Return a link through threads for a device that is open in hidapi; `lock_fd` is closed with it.

    Raises RuntimeError if the system has no thread left; both are closed then.
    """
    report = options.reports.input
    write_timeout_s = min(options.timeout_s, IGNORED_WRENCH_MAX_S)
    threads = ReportThreads(device, report.bytes + (report.id != 0) + exchange.IN_SPARE, write_timeout_s, lock_fd)
    return ReportLink(threads.fd, threads)


def find_device(options: Options) -> str:
    """Return the path of the only device with the rig's ids and reports: its node, or else hidapi's path on the bus.

    Raises DeviceNotFound if there is none or more than one. If it has to read the reports of several interfaces of one
    device, it also raises the errors of `open_usb`.
    """
    nodes_found = list(discovery.iter_hidraw_nodes())
    usb_ids = (options.vendor_id, options.product_id)
    nodes = {node.node: node for node in nodes_found if (node.vendor, node.product) == usb_ids}
    # In a container, the system's table may list nodes that the container cannot access.
    if options.through != "node" and not any(map(os.path.exists, nodes)):
        interfaces = list_attached(*usb_ids)
        if interfaces:
            return _choose_on_bus(options, interfaces)
    if nodes:
        matching = {path: node.serial for path, node in nodes.items() if has_reports(node.descriptor, options.reports)}
        # If none has the rig's reports, opening one fails with a message about its reports.
        return _choose(options, matching or {path: node.serial for path, node in nodes.items()})
    without_node = [device for device in discovery.iter_usb_devices() if (device.vendor, device.product) == usb_ids]
    if without_node:
        raise DeviceNotFound(
            f"{without_node[0]} has no usable node: `sudo modprobe usbhid` creates one on hidraw; in a "
            f"container, `docker run --device {without_node[0].node or '/dev/bus/usb'}`"
        )
    present_ids = sorted({format_ids(node.vendor, node.product) for node in nodes_found})
    attached_text = f"attached are {', '.join(present_ids)}" if present_ids else "no HID device is attached"
    raise DeviceNotFound(
        f"no HID device {format_ids(*usb_ids)} is attached: plug it in and switch it on; {attached_text}"
    )


def _choose_on_bus(options: Options, interfaces: dict[str, str]) -> str:
    """Return the path of the rig's device from interfaces on the bus (serial number by path)."""
    paths_by_device: dict[str, list[str]] = {}
    for path in sorted(interfaces):
        paths_by_device.setdefault(path.partition(":")[0], []).append(path)
    paths = paths_by_device[
        _choose(options, {name: interfaces[device_paths[0]] for name, device_paths in paths_by_device.items()})
    ]
    if len(paths) > 1:
        paths = filter_by_reports(paths, options) or paths
    return paths[0]


def _choose(options: Options, serials: dict[str, str]) -> str:
    """Return the path with the rig's serial number from devices with its ids (serial number by path)."""
    usb_ids = format_ids(options.vendor_id, options.product_id)
    matching = [path for path, serial in serials.items() if options.serial is None or serial == options.serial]
    if len(matching) == 1:
        return matching[0]
    if matching:
        choices = ", ".join(f"{path} (serial '{serials[path]}')" for path in sorted(matching))
        raise DeviceNotFound(f"{len(matching)} HID devices are {usb_ids}: select one with serial or path: {choices}")
    serial_list = ", ".join(f"'{serial}'" for serial in sorted(serials.values()))
    raise DeviceNotFound(
        f"no HID device {usb_ids} has the serial number '{options.serial}': attached are {serial_list}"
    )


def _open_hidapi(path: str) -> HidApi:
    """Open the node again, through hidapi's hidraw backend; raises DeviceError if that fails."""
    device: Any = import_hidapi("hidraw").device()
    try:
        device.open_path(os.fsencode(path))
    except OSError as error:
        raise DeviceError(f"{path} cannot be opened by hidapi: {device.error()}: set through to node") from error
    opened: HidApi = device
    return opened


def _read_descriptor(fd: int, path: str) -> bytes:
    try:
        size = bytearray(4)
        fcntl.ioctl(fd, _GET_DESCRIPTOR_SIZE, size)
        buffer = bytearray(size) + bytearray(_DESCRIPTOR_MAX)
        fcntl.ioctl(fd, _GET_DESCRIPTOR, buffer)
    except OSError as error:
        raise DeviceError(f"{path} does not return its report descriptor: {error.strerror}") from error
    return bytes(buffer[4 : 4 + struct.unpack("<i", size)[0]])
