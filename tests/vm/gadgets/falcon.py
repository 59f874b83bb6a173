"""Falcon as a USB device of the guest's kernel: its chip's requests and its two endpoints, through FunctionFS.

    python falcon.py SOCKET '{"place": [0, 0, 0.01]}'

The case is that of the emulator (emulators/falcon.py), with serial. Lines over the socket: `displayed`, `place`,
`seen`, `make CASE`, `mend`, `quit`; the cases:

not_found, lost   unplugged
busy              another program has claimed it
permission        its node is not accessible
timeout           its firmware sends no more packets, its chip does
blocked           accepts no transfer out
stalled           its endpoint in is halted
"""

from __future__ import annotations

import fcntl
import json
import os
import struct
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from emulators.falcon import from_case, to_world

from vm.gadgets.configfs import Gadget
from vm.gadgets.serving import serve

MOUNT = Path("/run/ffs-falcon")
PACKET = 64
# From <linux/usb/functionfs.h>.
DESCRIPTORS_MAGIC, STRINGS_MAGIC = 3, 2
HAS_FULL_SPEED, HAS_HIGH_SPEED, ALL_RECIPIENTS, BEFORE_CONFIGURATION = 1, 2, 64, 128
EVENT_BYTES, ENABLE, DISABLE, UNBIND, SETUP = 12, 2, 3, 1, 4
CLAIM_INTERFACE = 0x8004550F  # of <linux/usbdevice_fs.h>
SETTLE_S = 0.05
"""Longer than a packet takes on a slow emulated processor."""


def descriptors() -> bytes:
    """Return one vendor interface, bulk in 0x81 and out 0x02, of 64 bytes (512 at high speed, as required)."""
    interface = bytes([9, 4, 0, 0, 2, 255, 255, 255, 1])

    def ends(size: int) -> bytes:
        return b"".join(bytes([7, 5, end, 2]) + struct.pack("<HB", size, 0) for end in (0x81, 0x02))

    body = struct.pack("<II", 3, 3) + interface + ends(PACKET) + interface + ends(512)
    flags = HAS_FULL_SPEED | HAS_HIGH_SPEED | ALL_RECIPIENTS | BEFORE_CONFIGURATION
    return struct.pack("<III", DESCRIPTORS_MAGIC, 12 + len(body), flags) + body


def strings() -> bytes:
    text = struct.pack("<H", 0x0409) + b"FALCON HAPTIC\0"
    return struct.pack("<IIII", STRINGS_MAGIC, 16 + len(text), 1, 1) + text


class Chip:
    """Serial chip between the kernel's endpoints and the emulated device; a thread for each endpoint."""

    def __init__(self, case: dict) -> None:
        self.falcon = from_case(case)
        self.lock = threading.Condition()
        self.made = ""
        self.rival: int | None = None
        MOUNT.mkdir(exist_ok=True)
        while os.path.ismount(MOUNT):  # from an earlier process
            subprocess.run(["umount", MOUNT], check=True)
        self.gadget = Gadget(0, 0x0403, 0xCB48, "FTDI", "FALCON HAPTIC", case.get("serial", "SN42"))
        self.gadget.function("ffs.falcon")
        subprocess.run(["mount", "-t", "functionfs", "falcon", MOUNT], check=True)
        self.control = os.open(MOUNT / "ep0", os.O_RDWR)
        os.write(self.control, descriptors())
        os.write(self.control, strings())
        self.end_in, self.end_out = (os.open(MOUNT / name, os.O_RDWR) for name in ("ep1", "ep2"))
        self.enabled = False
        for run in (self._controls, self._takes, self._gives):
            threading.Thread(target=run, daemon=True).start()
        self.gadget.plug()

    def _controls(self) -> None:
        while True:
            events = os.read(self.control, 4 * EVENT_BYTES)
            for at in range(0, len(events), EVENT_BYTES):
                kind, request, value, index, length, event = struct.unpack_from("<BBHHHB", events, at)
                with self.lock:
                    if event == SETUP:
                        self._request(kind, request, value, index, length)
                    elif event in (ENABLE, DISABLE, UNBIND):
                        self.enabled = event == ENABLE
                        self.lock.notify_all()

    def _request(self, kind: int, request: int, value: int, index: int, length: int) -> None:
        if kind & 0x80:  # the wrong direction, which stalls it
            with suppress(OSError):
                os.read(self.control, 0)
            return
        self.falcon.request(kind, request, value, index)
        self.lock.notify_all()
        os.read(self.control, length)

    def _wait_enabled(self, *unless: str) -> None:
        with self.lock:
            while not self.enabled or self.made in unless:
                self.lock.wait()

    def _takes(self) -> None:
        while True:
            self._wait_enabled("blocked")
            try:
                data = os.read(self.end_out, PACKET)
            except OSError:  # unplugged while it waited
                time.sleep(0.01)
                continue
            with self.lock:
                while self.made == "blocked":  # a read was pending: its data and the rest wait
                    self.lock.wait()
                before = len(self.falcon.reply)
                self.falcon.write(data)
                if self.made == "timeout":
                    del self.falcon.reply[before:]
                self.lock.notify_all()

    def _gives(self) -> None:
        while True:
            self._wait_enabled("stalled")
            with self.lock:
                if not self.falcon.reply:  # the chip sends its status each `latency_ms`
                    self.lock.wait(max(1, self.falcon.latency_ms) / 1e3)
                data = self.falcon.read(PACKET)
            try:
                os.write(self.end_in, data)
            except OSError:
                time.sleep(0.01)

    def displayed(self) -> tuple[float, ...]:
        time.sleep(SETTLE_S)
        with self.lock:
            return to_world(self.falcon.displayed) if self.gadget.plugged else (0.0, 0.0, 0.0)

    def place(self) -> tuple[float, ...]:
        with self.lock:
            return self.falcon.at

    def seen(self) -> dict:
        time.sleep(SETTLE_S)
        with self.lock:
            return self.falcon.seen()

    def make(self, case: str) -> None:
        node = self.gadget.node or ""
        if case in ("not_found", "lost"):
            self.gadget.unplug()
            with self.lock:
                self.falcon.unplugged()
        elif case == "busy":
            self.rival = os.open(node, os.O_RDWR)
            fcntl.ioctl(self.rival, CLAIM_INTERFACE, struct.pack("<I", 0))
        elif case == "permission":
            os.chmod(node, 0)
        with self.lock:
            self.made = case
            self.lock.notify_all()
        if case == "stalled":
            time.sleep(SETTLE_S)  # the pending write completes
            with suppress(OSError):  # FunctionFS: the wrong direction, which halts the endpoint
                os.read(self.end_in, PACKET)

    def mend(self) -> None:
        with self.lock:
            self.made = ""
            self.lock.notify_all()
        if self.rival is not None:
            os.close(self.rival)
            self.rival = None
        if self.gadget.plugged:
            os.chmod(self.gadget.node or "", 0o600)
        else:
            self.gadget.plug()


if __name__ == "__main__":
    chip = Chip(json.loads(sys.argv[2]))
    serve(sys.argv[1], chip)
    chip.gadget.unplug()
    os._exit(0)  # the threads wait for a host
