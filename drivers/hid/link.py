"""Selection of the path of reports: the node, or two threads between hidapi and the exchange."""

from __future__ import annotations

import fcntl
import os
import struct
from typing import Any, Final, NamedTuple

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.drivers.base import IGNORED_WRENCH_MAX_S
from softfinger.drivers.hid import exchange, usb
from softfinger.drivers.hid.descriptor import check_reports, has_reports
from softfinger.drivers.hid.options import Options
from softfinger.drivers.hid.report_threads import HidApi, ReportThreads
from softfinger.drivers.system import discovery
from softfinger.drivers.system.hidraw import import_hidapi, open_path, read_ids

# Requests for ioctl, from <linux/hidraw.h>.
_GET_DESCRIPTOR_SIZE: Final = 0x80044801
_GET_DESCRIPTOR: Final = 0x90044802
_DESCRIPTOR_MAX: Final = 4096


class ReportLink(NamedTuple):
    """File descriptor that the exchange reads and writes: a node, or with a pump the socket that replaces it.

    node  path of the device's hidraw node; empty on the USB bus
    """

    fd: int
    threads: ReportThreads | None = None
    node: str = ""


def open_link(options: Options) -> ReportLink:
    """Find the device of a rig and open it with the method that the rig selects.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, or DeviceError if it is another device, or has other reports
    than the rig.
    """
    path = options.path or find_device(options)
    if not path.startswith("/"):
        opened = usb.open_usb(path, options)
        return link_by_threads(opened.device, options, opened.lock_fd)
    fd = open_path(path, options.vendor_id, options.product_id)
    try:
        check_reports(_read_descriptor(fd, path), path, options.reports)
        if options.through != "thread":
            return ReportLink(fd, None, path)
        return link_by_threads(_open_hidapi(path), options, fd)._replace(node=path)
    except BaseException:
        os.close(fd)
        raise


def link_by_threads(device: HidApi, options: Options, lock_fd: int | None = None) -> ReportLink:
    """Return a link through threads for a device that is open in hidapi; `lock_fd` is closed with it."""
    report = options.reports.input
    write_timeout_s = min(options.timeout_s, IGNORED_WRENCH_MAX_S)
    threads = ReportThreads(device, report.bytes + (report.id != 0) + exchange.IN_SPARE, write_timeout_s, lock_fd)
    return ReportLink(threads.fd, threads)


def find_device(options: Options) -> str:
    """Return the path of the only device with the rig's ids and reports: its node, or else hidapi's path on the bus.

    Raises DeviceNotFound if there is none or more than one. If it has to read the reports of several interfaces of one
    device, it also raises the errors of `usb.open_usb`.
    """
    nodes_found = list(discovery.iter_hidraw_nodes())
    usb_ids = (options.vendor_id, options.product_id)
    nodes = {node.node: node for node in nodes_found if (node.vendor, node.product) == usb_ids}
    # In a container, the system's table may list nodes that the container cannot access.
    if options.through != "node" and not any(map(os.path.exists, nodes)):
        interfaces = usb.list_attached(*usb_ids)
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
    present_ids = sorted({read_ids(node.vendor, node.product) for node in nodes_found})
    attached_text = f"attached are {', '.join(present_ids)}" if present_ids else "no HID device is attached"
    raise DeviceNotFound(
        f"no HID device {read_ids(*usb_ids)} is attached: plug it in and switch it on; {attached_text}"
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
        paths = usb.with_reports_of(paths, options) or paths
    return paths[0]


def _choose(options: Options, serials: dict[str, str]) -> str:
    """Return the path with the rig's serial number from devices with its ids (serial number by path)."""
    usb_ids = read_ids(options.vendor_id, options.product_id)
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
