"""Emulated WoodenHaptics as a hidraw node of umockdev, and a program that sees no other devices.

    umockdev-wrapper /usr/bin/python3 testbed.py '{"arm": "woody-2019", "generation": 2}' program argument ...

Needs Debian's umockdev, gir1.2-umockdev-1.0 and python3-gi. The exit code is the program's; the state of the emulated
arm is the last line of standard output, as JSON.

Keys of the first argument: arm (a row of the emulator's table), generation (1 or 2), and optionally board (a row of
boards.py; by default a single interface), descriptor (hex), place (m), press (m: downward motion of the hand), drag (m:
sideways motion), lost_after (reports until the device is unplugged), short_after (reports until it sends short ones),
mute_after, block_after (reports until a write blocks for ever), permission (mode of the node, octal text).
"""

import contextlib
import glob
import json
import os
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from emulators.boards import BOARDS, Board, Interface, raw_hid  # noqa: E402
from emulators.hand import stroke  # noqa: E402
from emulators.woodenhaptics import Woody  # noqa: E402

LIMIT_S = 240.0
"""A cold cache on a busy machine takes minutes. Callers of the emulation wait longer, so no process outlives them."""
ZERO_S = 10.0
"""Time for the watcher of a killed program."""
IDS = {1: (0x1234, 0x0006), 2: (0x16C0, 0x0486)}
EAGAIN, EIO, ENODEV, ENOTTY = 11, 5, 19, 25
# From <linux/hidraw.h>: descriptor size, descriptor, bus and ids.
GET_SIZE, GET_DESCRIPTOR, GET_INFO = 0x80044801, 0x90044802, 0x80084803
DEVICE = "/devices/pci0000:00/0000:00:14.0/usb1/1-1"


class Bed:
    node_path = "/dev/hidraw0"

    def __init__(self, case: dict) -> None:
        self.case = case
        generation = case["generation"]
        intention = stroke(tuple(case.get("place", (0.0, 0.0, 0.0))), case.get("press", 0.0), case.get("drag", 0.0))
        size = {1: 8, 2: 64}[generation]
        only = Interface(raw_hid(size), 0x81, 0x02, size, size)
        self.board = BOARDS[case["board"]] if "board" in case else Board(*IDS[generation], "Emulated arm", (only,))
        self.ids, self.name = (self.board.vendor, self.board.product), self.board.name
        mine = self.board.interfaces[self.board.arm].descriptor
        self.descriptor = bytes.fromhex(case["descriptor"]) if "descriptor" in case else mine
        self.woody = Woody(case["arm"], generation, intention, mine[mine.index(0x95) + 1])
        self.astray = 0
        """Reports to interfaces other than the arm's."""
        self.process: subprocess.Popen | None = None
        self.queue: list[bytes] = []
        self.blocked: list[object] = []
        self._wire()
        if "permission" in case:
            os.chmod(self.bed.get_root_dir() + self.node_path, int(case["permission"], 8))

    def _wire(self) -> None:
        self.bed = UMockdev.Testbed.new()
        for text in self.hidraw_table():
            self.bed.add_from_string(text)
        self.nodes = []
        for number, interface in enumerate(self.board.interfaces):
            mine = number == self.board.arm
            node = UMockdev.IoctlBase()
            node.connect("handle-ioctl", self._ioctl, self.descriptor if mine else interface.descriptor)
            node.connect("handle-read", self._read if mine else self._read_nothing)
            node.connect("handle-write", self._write if mine else self._write_astray)
            self.bed.attach_ioctl(f"/dev/hidraw{number}", node)
            self.nodes.append(node)
        # The node is a pseudo terminal here: a byte in it makes poll report input.
        self.terminal = self.bed.get_dev_fd(f"/dev/hidraw{self.board.arm}")

    def hidraw_table(self) -> tuple[str, ...]:
        vendor, product = self.ids
        texts = [
            f"P: {DEVICE}\nE: DEVTYPE=usb_device\nE: SUBSYSTEM=usb\nA: idVendor={vendor:04x}\\n\n"
            f"A: idProduct={product:04x}\\n\nA: bcdDevice=0100\\n\nA: serial=SN42\\n\nA: busnum=1\\n\nA: devnum=2\\n\n"
        ]
        for n, interface in enumerate(self.board.interfaces):
            descriptor = self.descriptor if n == self.board.arm else interface.descriptor
            hid = f"{DEVICE}/1-1:1.{n}/0003:{vendor:04X}:{product:04X}.000{1 + n}"
            texts += [
                f"P: {DEVICE}/1-1:1.{n}\nE: DEVTYPE=usb_interface\nE: DRIVER=usbhid\nE: SUBSYSTEM=usb\n"
                f"A: bInterfaceNumber=0{n}\\n\nA: bInterfaceClass=03\\n\n",
                f"P: {hid}\nE: DRIVER=hid-generic\nE: HID_ID=0003:{vendor:08X}:{product:08X}\nE: HID_NAME={self.name}\n"
                f"E: HID_UNIQ=SN42\nE: SUBSYSTEM=hid\nH: report_descriptor={descriptor.hex().upper()}\n",
                f"P: {hid}/hidraw/hidraw{n}\nN: hidraw{n}\nE: DEVNAME=/dev/hidraw{n}\nE: MAJOR=240\nE: MINOR={n}\n"
                f"E: SUBSYSTEM=hidraw\nL: device=../../../0003:{vendor:04X}:{product:04X}.000{1 + n}\n",
            ]
        return tuple(texts)

    def _ioctl(self, _: object, client: object, descriptor: bytes) -> bool:
        request, argument = client.get_request(), client.get_arg()
        if request == GET_SIZE:
            argument.resolve(0, 4).update(0, struct.pack("<i", len(descriptor)))
        elif request == GET_DESCRIPTOR:
            argument.resolve(0, 4100).update(4, descriptor)
        elif request == GET_INFO:
            argument.resolve(0, 8).update(0, struct.pack("<IHH", 3, *self.ids))
        else:
            client.complete(-1, ENOTTY)
            return True
        client.complete(0, 0)
        return True

    def _past(self, event: str) -> bool:
        return self.woody.steps >= self.case.get(event, float("inf"))

    def _read(self, _: object, client: object) -> bool:
        result = client.execute()
        count = result[0] if isinstance(result, tuple) else result
        if self._past("lost_after"):
            client.complete(-1, EIO)
            return True
        for _ in range(max(0, count - 1)):
            os.write(self.terminal, b"\1")
        if count > 0 and self.queue:
            data = self.queue.pop(0)[: len(client.get_arg().retrieve())]
            client.get_arg().update(0, data)
            client.complete(len(data), 0)
        else:
            client.complete(-1, EAGAIN)
        return True

    def _write(self, _: object, client: object) -> bool:
        data = bytes(client.get_arg().retrieve())
        if self._past("lost_after"):
            client.complete(-1, ENODEV)
            return True
        if self._past("block_after"):
            self.blocked.append(client)  # never answered
            return True
        if self.take(data):
            os.write(self.terminal, b"\1")
        client.complete(len(data), 0)
        return True

    def _read_nothing(self, _: object, client: object) -> bool:
        client.complete(-1, EAGAIN)
        return True

    def _write_astray(self, _: object, client: object) -> bool:
        self.astray += 1
        client.complete(len(client.get_arg().retrieve()), 0)
        return True

    def take(self, data: bytes) -> bool:
        answer = self.woody.answer(data)
        answered = not self._past("mute_after")
        if answered:
            self.queue.append(answer[:5] if self._past("short_after") else answer)
        return answered

    def seen(self) -> dict:
        w = self.woody
        return {
            "reports": len(w.sent), "last": w.sent[-1:] and list(w.sent[-1]), "place": w.place,
            "most": [max((abs(s[k]) for s in w.sent), default=0) for k in range(3)], "astray": self.astray,
        }  # fmt: skip


def is_open(path: str) -> bool:
    """Return True if a process has opened the file."""
    for fd in glob.glob("/proc/[0-9]*/fd/*"):
        with contextlib.suppress(OSError):  # the process has ended, or is another user's
            if os.readlink(fd) == path:
                return True
    return False


def main(make: Callable[[dict], Any] = Bed) -> None:
    bed, loop, code = make(json.loads(sys.argv[1])), GLib.MainLoop(), []
    command = sys.argv[2:]
    if os.geteuid() == 0:  # root may open any file
        command = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search", *command]

    def run() -> None:
        # In the environment of the C library, to which umockdev has added the paths of the emulated files.
        try:
            bed.process = subprocess.Popen(command)
            code.append(bed.process.wait(LIMIT_S))
            until, node = time.monotonic() + ZERO_S, bed.bed.get_root_dir() + bed.node_path
            while "kill_after" in bed.case and is_open(node) and time.monotonic() < until:
                time.sleep(0.01)
        except subprocess.TimeoutExpired:
            print(f"{command}: has not ended within {LIMIT_S:g} s", file=sys.stderr, flush=True)
            bed.process.kill()
            code.append(124)  # as of timeout(1)
        loop.quit()

    threading.Thread(target=run, daemon=True).start()
    loop.run()
    print(json.dumps(bed.seen()), flush=True)
    shutil.rmtree(bed.bed.get_root_dir(), ignore_errors=True)
    os._exit(code[0] & 255)  # umockdev's threads would block the exit of the process


if __name__ == "__main__":
    main()
