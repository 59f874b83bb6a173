"""Discovery of USB devices, hidraw nodes and serial ports, with the processes and users that may access them.

Nothing is opened: names and numbers are read from sysfs, so that discovery does not disturb a device in use. It also
lists devices that this user may not open.
"""

from __future__ import annotations

import errno
import grp
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, Literal, NamedTuple

Bus = Literal["usb", "hid", "serial", "library", "service"]
"""List that has a device: a table of the system, or the maker's library or service."""

ROOT: Final = Path("/")
USB: Final = Path("sys/bus/usb/devices")
HIDRAW: Final = Path("sys/class/hidraw")
TTY: Final = Path("sys/class/tty")
USB_PORTS: Final = ("ttyACM", "ttyUSB")
"""Prefixes of serial ports on USB; the table also contains every terminal of the system."""

READ_AND_WRITE_BY_GROUP: Final = stat.S_IRGRP | stat.S_IWGRP


NO_PRODUCT: Final = "serial port"
"""Name of a port whose device has no product string."""


class SystemDevice(NamedTuple):
    """Device listed by the system.

    node        path that a driver opens; empty if there is none
    descriptor  report descriptor of a HID device; empty if the system does not provide it
    """

    bus: Bus
    vendor: int
    product: int
    name: str
    serial: str
    node: str
    descriptor: bytes = b""

    @property
    def ids(self) -> str:
        return f"{self.vendor:04x}:{self.product:04x}"

    def __str__(self) -> str:
        return f"{self.name} ({self.ids}) at {self.node or 'no node'}"


class Holder(NamedTuple):
    """Process that has a node open."""

    pid: int
    name: str

    def __str__(self) -> str:
        return f"process {self.pid} ({self.name})"


def list_attached(root: Path = ROOT) -> list[SystemDevice]:
    """Return every hidraw node and serial port on USB, and every USB device that has neither, except hubs.

    root  folder that contains sys and dev
    """
    nodes = [*iter_hidraw_nodes(root), *iter_serial_ports(root)]
    listed_ids = {(node.vendor, node.product) for node in nodes}
    return [*nodes, *(device for device in iter_usb_devices(root) if (device.vendor, device.product) not in listed_ids)]


def has_usb(root: Path = ROOT) -> bool:
    """Return True if the system has a USB bus."""
    return os.path.isdir(root / USB)  # also False if this user may not read the folder


def list_names(root: Path = ROOT) -> frozenset[str]:
    """Return the names of attached devices in the system's tables; cheap enough to call every second."""
    return frozenset(
        str(folder / name)
        for folder, is_one in ((USB, _is_device), (HIDRAW, bool), (TTY, _is_port))
        for name in _list_names(root / folder)
        if is_one(name)
    )


def read_device(name: str, root: Path = ROOT) -> SystemDevice | None:
    """Return the device for one of `list_names`; None if it was unplugged, or is a hub."""
    path = root / name
    if path.parent == root / TTY:
        return _read_serial_port(path)
    return _read_hidraw_node(path) if path.parent == root / HIDRAW else _read_usb_device(path)


def iter_hidraw_nodes(root: Path = ROOT) -> Iterator[SystemDevice]:
    """Yield every hidraw node, in numeric order."""
    folder = root / HIDRAW
    for name in _sort_by_number(_list_names(folder)):
        if (node := _read_hidraw_node(folder / name)) is not None:
            yield node


def iter_serial_ports(root: Path = ROOT) -> Iterator[SystemDevice]:
    """Yield every serial port on USB, in numeric order."""
    folder = root / TTY
    for name in _sort_by_number(filter(_is_port, _list_names(folder))):
        if (port := _read_serial_port(folder / name)) is not None:
            yield port


def find_serial_port(node: str, root: Path = ROOT) -> SystemDevice | None:
    """Return the device of a port's node or of a link to it; None if the port is not on USB."""
    return _read_serial_port(root / TTY / os.path.basename(os.path.realpath(node)))


def iter_usb_devices(root: Path = ROOT) -> Iterator[SystemDevice]:
    """Yield every USB device except hubs."""
    folder = root / USB
    for name in sorted(_list_names(folder)):
        if _is_device(name) and (device := _read_usb_device(folder / name)) is not None:
            yield device


def is_same_node(path: str, node: str) -> bool:
    """Return True if a path is a node or a link to it, such as one in /dev/serial/by-id."""
    return bool(path) and os.path.realpath(path) == os.path.realpath(node)


def is_permitted(node: str) -> bool:
    """Return True if this user may read and write a node."""
    acting_for_another = os.geteuid() != os.getuid()
    return os.access(node, os.R_OK | os.W_OK, effective_ids=acting_for_another)


def find_holder(node: str) -> Holder | None:
    """Return the process that has locked a node, else another process that has it open; None if none is visible.

    /proc/locks lists the locks of all users, but open files are visible only for processes that this user may inspect.
    """
    try:
        node_stat = os.stat(node)
    except OSError:
        return None
    for pid in _iter_pids_with_lock(node_stat):
        return read_process(pid)
    for folder in Path("/proc").glob("[0-9]*/fd"):
        pid = int(folder.parent.name)
        if pid == os.getpid():
            continue
        for entry in _list_names(folder):
            try:
                if os.path.samestat(os.stat(folder / entry), node_stat):
                    return read_process(pid)
            except OSError:
                continue
    return None


def find_group_with_access(node: str) -> str | None:
    """Return a group other than root's that may read and write a node; None if there is none."""
    try:
        status = os.stat(node)
        has_access = status.st_gid != 0 and status.st_mode & READ_AND_WRITE_BY_GROUP == READ_AND_WRITE_BY_GROUP
        return grp.getgrgid(status.st_gid).gr_name if has_access else None
    except (OSError, KeyError):
        return None


def _sort_by_number(names: Iterable[str]) -> list[str]:
    return sorted(names, key=lambda text: (len(text), text))


def _list_names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):  # unknown: not empty
            raise
        return []


def _is_device(name: str) -> bool:
    """Return True for a device: interfaces have a colon in their name (1-1:1.0), root hubs start with usb (usb1)."""
    return ":" not in name and not name.startswith("usb")


def _is_port(name: str) -> bool:
    return name.startswith(USB_PORTS)


def _read_text(path: Path) -> str:
    return _read_bytes(path).decode(errors="replace").strip()


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _parse_int(text: str, base: int) -> int | None:
    try:
        return int(text, base)
    except ValueError:
        return None


def _read_hidraw_node(path: Path) -> SystemDevice | None:
    # HID_ID=bus:vendor:product in hexadecimal digits, HID_NAME, HID_UNIQ
    uevent = dict(line.split("=", 1) for line in _read_text(path / "device" / "uevent").splitlines() if "=" in line)
    numbers = [_parse_int(part, 16) for part in uevent.get("HID_ID", "").split(":")]
    if len(numbers) != 3 or numbers[1] is None or numbers[2] is None:
        return None
    name = uevent.get("HID_NAME") or "HID device"
    descriptor = _read_bytes(path / "device" / "report_descriptor")
    return SystemDevice(
        "hid", numbers[1], numbers[2], name, uevent.get("HID_UNIQ", ""), f"/dev/{path.name}", descriptor
    )


def _read_usb_device(path: Path) -> SystemDevice | None:
    vendor, product = (_parse_int(_read_text(path / key), 16) for key in ("idVendor", "idProduct"))
    if vendor is None or product is None or _read_text(path / "bDeviceClass") == "09":  # a hub
        return None
    bus, number = (_parse_int(_read_text(path / key), 10) for key in ("busnum", "devnum"))
    node = "" if bus is None or number is None else find_usb_node(bus, number)
    return SystemDevice(
        "usb", vendor, product, _read_text(path / "product") or "USB device", _read_text(path / "serial"), node
    )


def _read_serial_port(path: Path) -> SystemDevice | None:
    # `device` links to the port's interface, in a subfolder of its USB device
    for folder in (path / "device").resolve().parents:
        vendor, product = (_parse_int(_read_text(folder / key), 16) for key in ("idVendor", "idProduct"))
        if vendor is not None and product is not None:
            name = _read_text(folder / "product") or NO_PRODUCT
            return SystemDevice("serial", vendor, product, name, _read_text(folder / "serial"), f"/dev/{path.name}")
    return None


def find_usb_node(bus: int, number: int) -> str:
    return f"/dev/bus/usb/{bus:03d}/{number:03d}"


def _iter_pids_with_lock(file: os.stat_result) -> Iterator[int]:
    # 1: FLOCK ADVISORY WRITE pid major:minor:inode start end; major and minor of the file system in hexadecimal digits.
    # Files of two file systems may have the same inode.
    name = f"{os.major(file.st_dev):02x}:{os.minor(file.st_dev):02x}:{file.st_ino}"
    for line in _read_text(Path("/proc/locks")).splitlines():
        part = line.split()
        if len(part) > 5 and part[1] == "FLOCK" and part[5] == name and part[4].isdecimal():
            yield int(part[4])


def read_process(pid: int) -> Holder:
    """Return a process with its name."""
    return Holder(pid, _read_text(Path(f"/proc/{pid}/comm")) or "not visible")
