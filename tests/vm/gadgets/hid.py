"""HID devices of the guest's kernel, on its USB bus (f_hid) or passed to its HID layer by a program (uhid)."""

from __future__ import annotations

import os
import select
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from vm.gadgets.configfs import PLUG_S, Gadget, settle

HIDRAW = Path("/sys/class/hidraw")
POLL_MS = 20
# From <linux/uhid.h>.
DESTROY, OUTPUT, CREATE, INPUT = 1, 6, 11, 12
EVENT_BYTES, DATA_MAX, DESCRIPTOR_MAX = 4380, 4096, 4096
BUS_USB = 3


class HidDevice(ABC):
    """A device with a thread that passes the host's reports to `take(report)`, with the report's id or 0 first."""

    def __init__(self, vendor: int, product: int, take: Callable[[bytes], None]) -> None:
        self.ids, self._take = (vendor, product), take
        self.blocked = False
        """If set, it accepts no report."""
        threading.Thread(target=self._run, daemon=True).start()

    @abstractmethod
    def _poll(self) -> bytes | None:
        """Return the next report of the host, or None after a while without one."""

    @abstractmethod
    def send(self, report: bytes) -> None:
        """Send a report to the host; it is lost if there is none."""

    @abstractmethod
    def plug(self) -> None:
        """Plug it in, and wait until the host has its node."""

    @abstractmethod
    def unplug(self) -> None:
        """Unplug it, and wait until the node is removed; may be called repeatedly."""

    def _run(self) -> None:
        while True:
            if self.blocked:
                time.sleep(POLL_MS / 1e3)
            elif (report := self._poll()) is not None:
                self._take(report)

    @property
    def node(self) -> str | None:
        """Node of the device, or None."""
        wanted = f":{self.ids[0]:08X}:{self.ids[1]:08X}"
        for path in HIDRAW.iterdir():
            with suppress(OSError):
                if wanted in (path / "device/uevent").read_text():
                    return f"/dev/{path.name}"
        return None

    def _await(self, exists: bool) -> None:
        until = time.monotonic() + PLUG_S
        while (self.node is not None and os.path.exists(self.node)) != exists:
            if time.monotonic() > until:
                raise TimeoutError(f"the device's node is {self.node}")
            time.sleep(0.01)
        settle()


class UsbHid(HidDevice):
    """On the bus: one interface, interrupt endpoints in and out, reports without ids."""

    def __init__(
        self, vendor: int, product: int, name: str, descriptor: bytes, size: int, take: Callable[[bytes], None]
    ) -> None:
        self._size, self._end = size, -1
        self._gadget = Gadget(1, vendor, product, "Emulators", name, "SN42")
        self._gadget.function(
            "hid.arm", protocol="0", subclass="0", report_length=str(size), report_desc=descriptor
        )  # fmt: skip
        super().__init__(vendor, product, take)

    def plug(self) -> None:
        self._gadget.plug()
        (node,) = Path("/dev").glob("hidg*")
        self._end = os.open(node, os.O_RDWR | os.O_NONBLOCK)
        self._await(True)

    def unplug(self) -> None:
        end, self._end = self._end, -1
        if end >= 0:
            time.sleep(2 * POLL_MS / 1e3)  # the thread no longer uses it
            os.close(end)
        self._gadget.unplug()
        self._await(False)

    def _poll(self) -> bytes | None:
        end = self._end
        if end < 0 or not self._ready(end, select.POLLIN):
            return None
        with suppress(OSError):
            return b"\0" + os.read(end, self._size)
        return None

    def send(self, report: bytes) -> None:
        end = self._end
        # the host requests each report: the previous may still be waiting
        if end >= 0 and self._ready(end, select.POLLOUT):
            with suppress(OSError):
                os.write(end, report)

    def _ready(self, end: int, event: int) -> bool:
        poll = select.poll()
        poll.register(end, event)
        return bool(poll.poll(POLL_MS))


class Uhid(HidDevice):
    """Passed to the HID layer without a bus: delays are only the kernel's."""

    def __init__(
        self, vendor: int, product: int, name: str, descriptor: bytes, take: Callable[[bytes], None]
    ) -> None:  # fmt: skip
        self._name, self._descriptor, self._plugged = name, descriptor, False
        self._end = os.open("/dev/uhid", os.O_RDWR)
        super().__init__(vendor, product, take)

    def plug(self) -> None:
        texts = struct.pack("<128s64s64s", self._name.encode(), b"usb-emulated/input0", b"SN42")
        numbers = struct.pack("<HHIIII", len(self._descriptor), BUS_USB, *self.ids, 0x100, 0)
        os.write(self._end, struct.pack("<I", CREATE) + texts + numbers + self._descriptor.ljust(DESCRIPTOR_MAX, b"\0"))
        self._plugged = True
        self._await(True)

    def unplug(self) -> None:
        if self._plugged:
            self._plugged = False
            os.write(self._end, struct.pack("<I", DESTROY))
        self._await(False)

    def _poll(self) -> bytes | None:
        event = os.read(self._end, EVENT_BYTES)
        if struct.unpack_from("<I", event)[0] != OUTPUT:
            return None
        (size,) = struct.unpack_from("<H", event, 4 + DATA_MAX)
        return event[4 : 4 + size]

    def send(self, report: bytes) -> None:
        with suppress(OSError):
            os.write(self._end, struct.pack("<IH", INPUT, len(report)) + report)
