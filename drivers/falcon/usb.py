"""Falcon on the USB bus: search, exclusive opening, and setup of its serial chip.

Everything before the loop uses pyusb; the loop calls libusb with the library and the handle of pyusb.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
from typing import Any, Final, NamedTuple

import usb.core
import usb.util

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceLost, DeviceNotFound, DevicePermission
from softfinger.drivers.falcon.packets import CHIP_BYTES, STATUS_BYTES
from softfinger.drivers.system import libusb
from softfinger.drivers.system.discovery import find_usb_node
from softfinger.drivers.system.rules import explain_permission

VENDOR: Final = 0x0403
PRODUCT: Final = 0xCB48
IDS: Final = f"{VENDOR:04x}:{PRODUCT:04x}"
INTERFACE: Final = 0
ENDPOINT_OUT: Final = 0x02
ENDPOINT_IN: Final = 0x81
TIMEOUT_MS: Final = 1000


# Requests of the chip, and their values.
_TO_CHIP: Final = 0x40  # vendor request, host to device
PURGE: Final = 0
PURGE_RECEIVED, PURGE_SENT = 1, 2
MODEM: Final = 1
RTS_LOW, DTR_LOW, DTR_HIGH = 0x0200, 0x0100, 0x0101
FLOW: Final = 2
NO_FLOW: Final = 0
BAUD: Final = 3
BAUD_9600, BAUD_140000, BAUD_1500000 = 0x4138, 0x0015, 0x0002
LINE: Final = 4
LINE_8N1: Final = 0x0008
LATENCY: Final = 9
LATENCY_BOOT_MS, LATENCY_RUN_MS = 16, 1


class Libusb(NamedTuple):
    """Arguments of the loop's calls: libusb as loaded by pyusb, its context, and the open device."""

    library: ctypes.CDLL
    context: int
    handle: int


class SerialChip:
    """Open Falcon: requests to its serial chip, and bytes over it. Raises DeviceLost if it does not accept them."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._received = bytearray()

    def request(self, request: int, value: int) -> None:
        try:
            self._device.ctrl_transfer(_TO_CHIP, request, value, 0, None, TIMEOUT_MS)
        except usb.core.USBError as error:
            raise _make_lost_error(error) from error

    def purge(self) -> None:
        self.request(PURGE, PURGE_RECEIVED)
        self.request(PURGE, PURGE_SENT)
        self._received.clear()

    def write(self, data: bytes) -> None:
        try:
            self._device.write(ENDPOINT_OUT, data, TIMEOUT_MS)
        except usb.core.USBError as error:
            raise _make_lost_error(error) from error

    def read(self, count: int, transfers: int) -> bytes:
        """Return up to `count` bytes from at most `transfers` transfers; one without data takes the chip's latency."""
        for _ in range(transfers):
            if len(self._received) >= count:
                break
            try:
                self._received += bytes(self._device.read(ENDPOINT_IN, CHIP_BYTES, TIMEOUT_MS))[STATUS_BYTES:]
            except usb.core.USBTimeoutError:
                break
            except usb.core.USBError as error:
                raise _make_lost_error(error) from error
        data = bytes(self._received[:count])
        del self._received[:count]
        return data

    def set_run_mode(self) -> None:
        """Set the chip to the parameters of the running firmware."""
        self.purge()
        self.request(LATENCY, LATENCY_RUN_MS)
        self.request(BAUD, BAUD_1500000)
        self.purge()

    @property
    def node(self) -> str:
        """Path of the device on the USB bus."""
        return find_usb_node(self._device.bus, self._device.address)

    def libusb(self) -> Libusb:
        # pyusb publishes neither; both have been in its context since 1.0
        try:
            backend = self._device._ctx.backend
            handle = self._device._ctx.handle.handle
            return Libusb(backend.lib, int(backend.ctx.value), int(handle.value))
        except (AttributeError, TypeError) as error:
            raise DeviceError(
                f"pyusb {usb.__version__} is not compatible, unlike 1.3.1 ({error}): `pip install pyusb==1.3.1`"
            ) from error

    def close(self) -> None:
        """Release the device. May be called repeatedly."""
        with contextlib.suppress(usb.core.USBError):  # it may be disconnected
            usb.util.release_interface(self._device, INTERFACE)
        usb.util.dispose_resources(self._device)


def open_chip(serial: str | None, node: str | None = None) -> SerialChip:
    """Open the only attached Falcon, or the one with this serial number or node, and claim it for this process.

    Raises DeviceNotFound, DevicePermission, DeviceBusy or DeviceError.
    """
    try:
        devices = libusb.find(idVendor=VENDOR, idProduct=PRODUCT)
    except usb.core.USBError as error:
        raise DeviceError(f"USB devices cannot be listed: {error}: check that /dev/bus/usb exists") from error
    if node is not None:
        devices = [device for device in devices if find_usb_node(device.bus, device.address) == node]
    if not devices:
        raise DeviceNotFound(f"no Falcon ({IDS}) is attached: check USB cable and power")
    device = _choose(devices, serial)
    name = f"Falcon ({IDS}) at {find_usb_node(device.bus, device.address)}"
    try:
        with contextlib.suppress(NotImplementedError):  # libusb on a system without drivers to detach
            if device.is_kernel_driver_active(INTERFACE):
                device.detach_kernel_driver(INTERFACE)
        usb.util.claim_interface(device, INTERFACE)
    except usb.core.USBError as error:
        usb.util.dispose_resources(device)
        raise _make_open_error(name, error) from error
    return SerialChip(device)


def _choose(devices: list[Any], serial: str | None) -> Any:
    if serial is None and len(devices) == 1:
        return devices[0]
    serials = {}
    for device in devices:
        try:
            serials[device.serial_number or f"none, at {find_usb_node(device.bus, device.address)}"] = device
        except (usb.core.USBError, ValueError):  # ValueError: pyusb has no permission to open the device
            serials[f"? at {find_usb_node(device.bus, device.address)}"] = device
        usb.util.dispose_resources(device)  # reading the serial number opened it
    serial_list = ", ".join(f"'{serial}'" for serial in sorted(serials))
    if serial is None:
        raise DeviceNotFound(f"{len(devices)} Falcons are attached: select one with serial: {serial_list}")
    if serial not in serials:
        raise DeviceNotFound(f"no Falcon has the serial number '{serial}': attached are {serial_list}")
    return serials[serial]


def _make_open_error(name: str, error: usb.core.USBError) -> DeviceError:
    if error.errno in (errno.EACCES, errno.EPERM):
        return DevicePermission(f"{name} may not be opened by this user: {explain_permission(VENDOR, PRODUCT)}")
    if error.errno == errno.EBUSY:
        return DeviceBusy(f"{name} is used by another program: close it first")
    if error.errno in (errno.ENODEV, errno.ENOENT):
        return DeviceNotFound(f"{name} is no longer attached: check USB cable and power")
    return DeviceError(f"{name} cannot be opened: {error}: unplug it and plug it in again")


def _make_lost_error(error: usb.core.USBError) -> DeviceLost:
    return DeviceLost(f"the Falcon does not accept data ({error}): check USB cable and power")
