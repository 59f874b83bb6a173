"""Emulated Falcon as a USB device of umockdev, and a program that sees no other devices.

    umockdev-wrapper /usr/bin/python3 falcon_testbed.py '{"place": [0, 0, 0.01]}' program argument ...

Needs Debian's umockdev, gir1.2-umockdev-1.0 and python3-gi. The exit code is the program's; the state of the emulated
device is the last line of standard output, as JSON. The program reaches the device through the real libusb; this module
is the kernel that libusb calls. The program can change the device over the socket in SOFTFINGER_TESTBED, in lines:
`displayed`, `place`, `make CASE`, `mend`.

The first argument is the case of the emulator (`from_case` there), and also: serial, late_every (each n-th reply is 4
ms late), and steps after which a fault starts: lost_after, mute_after, broken_after (an error on the bus), block_after
(accepts no more transfers), garble_after (sends noise), unhomed_after (loses its zeros), weight_after (weight_kg is
added to the knob); second (the same for a second device).
"""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
import tempfile
import threading
import time
from pathlib import Path

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from emulators import bounded  # noqa: E402
from emulators.falcon import from_case, to_world  # noqa: E402

EAGAIN, EBUSY, EINVAL, ENODEV, ENODATA, ENOENT, ENOTTY, EPROTO, ESHUTDOWN = 11, 16, 22, 19, 61, 2, 25, 71, 108
# From <linux/usbdevice_fs.h>.
SUBMIT, DISCARD, REAP, REAP_NOW = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
CAPABILITIES, GET_DRIVER, CLAIM, RELEASE = 0x8004551A, 0x41045508, 0x8004550F, 0x80045510
SET_CONFIGURATION, RESET, CLEAR_HALT, IOCTL, SET_INTERFACE = 0x80045505, 0x5514, 0x80045515, 0xC0105512, 0x80085504
TAKEN = {SET_CONFIGURATION, RESET, CLEAR_HALT, SET_INTERFACE}
CONTROL, BULK = 2, 3
PORT = "/devices/pci0000:00/0000:00:14.0/usb1/1-"
NODES = "/dev/bus/usb/001/"


def descriptors() -> bytes:
    device = bytes([18, 1, 0, 2, 0, 0, 0, 8]) + struct.pack("<HHH", 0x0403, 0xCB48, 0x0400) + bytes([1, 2, 3, 1])
    interface = bytes([9, 4, 0, 0, 2, 255, 255, 255, 0])
    ends = b"".join(bytes([7, 5, end, 2, 64, 0, 0]) for end in (0x81, 0x02))
    body = interface + ends
    return device + bytes([9, 2]) + struct.pack("<H", 9 + len(body)) + bytes([1, 1, 0, 0x80, 45]) + body


def strings(serial: str) -> dict[int, bytes]:
    texts = {1: "FTDI", 2: "FALCON HAPTIC", 3: serial}
    found = {n: bytes([2 + 2 * len(t), 3]) + t.encode("utf-16le") for n, t in texts.items()}
    return {0: bytes([4, 3, 9, 4]), **found}


class Opened:
    """Requests of one opening of the node: the kernel returns each only to its own opening."""

    def __init__(self) -> None:
        self.done: list[object] = []
        self.waiting: list[tuple[object, object, int, float]] = []
        self.blocked: list[object] = []


class Bed:
    def __init__(self, case: dict, bed: object, port: int = 1) -> None:
        self.case, self.made = case, ""
        self.port, self.device, self.path = port, f"{PORT}{port}", f"{NODES}{1 + port:03d}"
        self.falcon = from_case(case)
        self.strings = strings(case.get("serial", "SN42"))
        self.opened: dict[object, Opened] = {}
        self.claimed: Opened | None = None
        self.ready_at = 0.0
        self.ioctls = 0
        self.bed = bed
        self._add()
        self.node = UMockdev.IoctlBase()
        self.node.connect("handle-ioctl", self._ioctl)
        self.bed.attach_ioctl(self.path, self.node)

    def _add(self) -> None:
        blob = descriptors().hex().upper()
        number = 1 + self.port
        names = f"BUSNUM=001 DEVNUM={number:03d} MAJOR=189 MINOR={self.port} PRODUCT=403/cb48/400 SUBSYSTEM=usb"
        names += " DEVTYPE=usb_device"
        attributes = (
            f"busnum=1 devnum={number} bConfigurationValue=1 bNumConfigurations=1 idVendor=0403 idProduct=cb48 speed=12"
        )
        lines = [f"P: {self.device}", f"N: {self.path.removeprefix('/dev/')}={blob}", f"E: DEVNAME={self.path}"]
        lines += [f"E: {word}" for word in names.split()] + [f"A: {word}\\n" for word in attributes.split()]
        self.bed.add_from_string("\n".join([*lines, f"H: descriptors={blob}", ""]))

    def _past(self, event: str) -> bool:
        return self.falcon.steps >= self.case.get(event, float("inf"))

    @property
    def lost(self) -> bool:
        return self.made == "lost" or self._past("lost_after")

    def _ioctl(self, _: object, client: object) -> bool:
        request, argument = client.get_request(), client.get_arg()
        mine = self.opened.setdefault(client, Opened())
        self.ioctls += 1
        code = 0
        if request == CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", 7))
        elif request == CLAIM:
            code = -EBUSY if self.made == "busy" or self.claimed not in (None, mine) else 0
            self.claimed = self.claimed if code else mine
        elif request == RELEASE:
            # Pending requests end when the node is closed, which umockdev does not report.
            self.claimed = None if self.claimed is mine else self.claimed
            mine.waiting, mine.blocked, mine.done = [], [], []
        elif request == GET_DRIVER:
            code = -ENODATA
        elif request == SUBMIT:
            code = self._submit(mine, argument)
        elif request in (REAP, REAP_NOW):
            code = self._reap(mine, argument)
        elif request == DISCARD:
            code = self._discard(mine)
        elif request not in TAKEN:
            code = -ENOTTY
        client.complete(-1 if code else 0, -code)
        return True

    def _submit(self, mine: Opened, argument: object) -> int:
        if self.lost:
            self.falcon.motors = (0, 0, 0)  # unplugged: no force
            return -ENODEV
        urb = argument.resolve(0, 56)
        raw = bytes(urb.retrieve())
        kind, end = raw[0], raw[1]
        length = struct.unpack_from("<i", raw, 24)[0]
        buffer = urb.resolve(16, length) if length else None
        if kind == CONTROL:
            self._control(mine, urb, buffer)
        elif end & 0x80:
            mine.waiting.append((urb, buffer, length, time.monotonic()))
        elif self._past("block_after"):
            mine.blocked.append(urb)
        else:
            before = len(self.falcon.reply)
            self.falcon.write(bytes(buffer.retrieve())[:length])
            self._spoil(before)
            self._finish(mine, urb, 0, length)
        return 0

    def _spoil(self, before: int) -> None:
        falcon, late = self.falcon, self.case.get("late_every")
        if self.made == "timeout" or self._past("mute_after"):
            del falcon.reply[before:]
        elif self._past("garble_after"):
            falcon.reply[before:] = os.urandom(16)
        elif self._past("unhomed_after"):
            falcon.found = [False] * 3
        if self._past("weight_after"):
            falcon.weight = self.case["weight_kg"] * 9.80665
        if self.made == "late":
            self.ready_at = time.monotonic() + 0.02
        if late and falcon.steps % late == 0:
            self.ready_at = time.monotonic() + 0.004

    def _control(self, mine: Opened, urb: object, buffer: object) -> None:
        setup = bytes(buffer.retrieve())
        kind, request, value, index, length = struct.unpack_from("<BBHHH", setup)
        if kind == 0x80 and request == 6 and value >> 8 == 3 and (value & 255) in self.strings:
            text = self.strings[value & 255][:length]
            buffer.update(8, text)
            self._finish(mine, urb, 0, len(text))
        elif kind & 0x80:
            self._finish(mine, urb, -EPROTO, 0)
        else:
            self.falcon.request(kind, request, value, index)
            self._finish(mine, urb, 0, length)

    def _finish(self, mine: Opened, urb: object, status: int, actual: int) -> None:
        urb.update(4, struct.pack("<i", status))
        urb.update(28, struct.pack("<i", actual))
        mine.done.append(urb)

    def _reap(self, mine: Opened, argument: object) -> int:
        if self.lost:
            self.falcon.motors = (0, 0, 0)
            for urb in [one[0] for one in mine.waiting] + mine.blocked:
                self._finish(mine, urb, -ESHUTDOWN, 0)
            mine.waiting, mine.blocked = [], []
        elif mine.waiting:
            urb, buffer, length, since = mine.waiting[0]
            now = time.monotonic()
            ready = self.falcon.reply and now >= self.ready_at
            if self._past("broken_after"):
                mine.waiting.pop(0)
                self._finish(mine, urb, -EPROTO, 0)
            elif ready or now - since >= self.falcon.latency_ms / 1e3:
                data = self.falcon.read(length if ready else 2)
                buffer.update(0, data)
                mine.waiting.pop(0)
                self._finish(mine, urb, 0, len(data))
        if not mine.done:
            return -ENODEV if self.lost else -EAGAIN
        argument.resolve(0, 8).set_ptr(0, mine.done.pop(0))
        return 0

    def _discard(self, mine: Opened) -> int:
        # The request's argument is the address of a URB in the program, which umockdev does not expose. Programs
        # discard only when they stop, and then all requests.
        waiting = [one[0] for one in mine.waiting] + mine.blocked
        mine.waiting, mine.blocked = [], []
        for urb in waiting:
            self._finish(mine, urb, -ENOENT, 0)
        return 0 if waiting else -EINVAL

    def answer(self, line: str) -> str:
        word, _, rest = line.partition(" ")
        if word == "displayed":
            return json.dumps(to_world((0.0, 0.0, 0.0) if self.lost else self.falcon.displayed))
        if word == "place":
            return json.dumps(self.falcon.at)
        node = os.path.join(self.bed.get_root_dir(), self.path.removeprefix("/"))
        if self.made == "not_found":
            self._add()
            self.bed.attach_ioctl(self.path, self.node)
            self.bed.uevent(f"/sys{self.device}", "add")
        elif self.made == "permission":
            os.chmod(node, 0o600)
        self.made = rest if word == "make" else ""
        if self.made == "not_found":
            self.bed.uevent(f"/sys{self.device}", "remove")
            self.bed.detach_ioctl(self.path)
            self.bed.remove_device(f"/sys{self.device}")
        elif self.made == "permission":
            os.chmod(node, 0)
        return "null"

    def seen(self) -> dict:
        return {**self.falcon.seen(), "ioctls": self.ioctls}


def serve(bed: Bed, path: str) -> None:
    server = socket.socket(socket.AF_UNIX)
    server.bind(path)
    server.listen()

    def run() -> None:
        while True:
            end, _ = server.accept()
            with end, end.makefile("rw") as stream:
                for line in stream:
                    answers: list[str] = []
                    ready = threading.Event()

                    def ask(text: str = line.strip(), into: list = answers, flag: threading.Event = ready) -> bool:
                        into.append(bed.answer(text))
                        flag.set()
                        return False

                    GLib.idle_add(ask, priority=GLib.PRIORITY_DEFAULT)
                    ready.wait()
                    stream.write(answers[0] + "\n")
                    stream.flush()

    threading.Thread(target=run, daemon=True).start()


def main() -> int:
    case, testbed, loop, code = json.loads(sys.argv[1]), UMockdev.Testbed.new(), GLib.MainLoop(), []
    bed = Bed(case, testbed)
    second = Bed(case["second"], testbed, 2) if "second" in case else None
    folder = tempfile.mkdtemp()
    path = os.path.join(folder, "testbed")
    serve(bed, path)
    os.environ["SOFTFINGER_TESTBED"] = path
    command = sys.argv[2:]
    if os.geteuid() == 0:  # root may open any file
        command = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search", *command]

    def run() -> None:
        # Pass on the environment of the C library, to which umockdev has added the paths of the emulated files.
        code.append(bounded.run(command))
        loop.quit()

    threading.Thread(target=run, daemon=True).start()
    loop.run()
    os.remove(path)
    os.rmdir(folder)
    print(json.dumps(bed.seen() | ({"second": second.seen()} if second else {})), flush=True)
    return code[0]


if __name__ == "__main__":
    result = main()
    sys.stdout.flush()
    os._exit(result)  # umockdev's threads would block the exit of the process
