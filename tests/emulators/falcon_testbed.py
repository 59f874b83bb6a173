"""Emulated Falcon as a USB device of umockdev, and a program that sees no other devices.

    umockdev-wrapper /usr/bin/python3 falcon_testbed.py '{"place": [0, 0, 0.01]}' program argument ...

Needs Debian's umockdev, gir1.2-umockdev-1.0 and python3-gi. The exit code is the program's; the state of the emulated
device is the last line of standard output, as JSON. The program reaches the device through the real libusb; this module
is the kernel that libusb calls. The program can change the device over the socket in SOFTFINGER_TESTBED, in lines:
`displayed`, `place`, `make CASE`, `mend`.

The first argument is the case of the emulator (`from_case` there), and also: serial, late_every (each n-th reply is 4
ms late), and steps after which a fault starts: lost_after, mute_after, broken_after (an error on the bus), block_after
(accepts no more transfers), garble_after (sends noise), unhomed_after (loses its zeros), weight_after (weight_kg is
added to the knob), kill_after (the program is killed).
"""

import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from emulators import testbed, usbfs
from emulators.falcon import from_case, to_world
from emulators.testbed import GLib, UMockdev

EPROTO = 71
INTERFACE = bytes([9, 4, 0, 0, 2, 255, 255, 255, 0])
ENDPOINTS = b"".join(bytes([7, 5, end, 2, 64, 0, 0]) for end in (0x81, 0x02))
CHIP = usbfs.descriptors((0x0403, 0xCB48), 0x0400, 8, 1, INTERFACE + ENDPOINTS)


class Bed(usbfs.UsbDevice):
    device, node_path = "/devices/pci0000:00/0000:00:14.0/usb1/1-1", "/dev/bus/usb/001/002"

    def __init__(self, case: dict) -> None:
        self.case, self.made = case, ""
        self.falcon = from_case(case)
        self.strings = usbfs.strings("FTDI", "FALCON HAPTIC", case.get("serial", "SN42"))
        self.claimed: usbfs.Stream | None = None
        self.ready_at = 0.0
        self.process: subprocess.Popen | None = None
        self.bed = UMockdev.Testbed.new()
        self._add()
        self.node = UMockdev.IoctlBase()
        self.node.connect("handle-ioctl", self.handle_ioctl)
        self.bed.attach_ioctl(self.node_path, self.node)
        path = os.path.join(self.bed.get_root_dir(), "testbed")
        self._serve(path)
        os.environ["SOFTFINGER_TESTBED"] = path  # the program changes the device through this socket

    def _add(self) -> None:
        names = "BUSNUM=001 DEVNUM=002 MAJOR=189 MINOR=1 PRODUCT=403/cb48/400 SUBSYSTEM=usb DEVTYPE=usb_device"
        attributes = (
            "busnum=1 devnum=2 bConfigurationValue=1 bNumConfigurations=1 idVendor=0403 idProduct=cb48 speed=12"
        )
        text = usbfs.device_text(self.device, self.node_path, CHIP, names.split(), attributes.split())
        self.bed.add_from_string(text)

    def _past(self, event: str) -> bool:
        return self.falcon.steps >= self.case.get(event, float("inf"))

    @property
    def lost(self) -> bool:
        return self.made == "lost" or self._past("lost_after")

    def power_off(self) -> None:
        self.falcon.motors = (0, 0, 0)

    def claim(self, stream: usbfs.Stream) -> bool:
        if self.process is not None and self.process.poll() is not None:
            self.claimed = None  # as the kernel does; umockdev does not report the end of a program
        if self.made == "busy" or self.claimed not in (None, stream):
            return False
        self.claimed = stream
        return True

    def release(self, stream: usbfs.Stream) -> None:
        self.claimed = None if self.claimed is stream else self.claimed

    def transfer(self, stream: usbfs.Stream, urb: object, end: int, buffer: object, length: int) -> None:
        if end & 0x80:
            usbfs.wait(stream, urb, buffer, length)
        elif self._past("block_after"):
            stream.blocked.append(urb)
        else:
            before = len(self.falcon.reply)
            self.falcon.write(bytes(buffer.retrieve())[:length])
            self._spoil(before)
            stream.finish(urb, 0, length)
            if self._past("kill_after") and any(self.falcon.motors):
                self.process.kill()

    def bulk(self, end: int, data: bytes) -> None:
        self.falcon.write(data)

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
        if late and falcon.steps % late == 0:
            self.ready_at = time.monotonic() + 0.004

    def control(self, stream: usbfs.Stream, urb: object, buffer: object) -> None:
        setup = bytes(buffer.retrieve())
        kind, request, value, index, length = struct.unpack_from("<BBHHH", setup)
        if kind == 0x80 and request == 6 and value >> 8 == 3 and (value & 255) in self.strings:
            text = self.strings[value & 255][:length]
            buffer.update(8, text)
            stream.finish(urb, 0, len(text))
        elif kind & 0x80:
            stream.finish(urb, -EPROTO, 0)
        else:
            self.falcon.request(kind, request, value, index)
            stream.finish(urb, 0, length)

    def deliver(self, stream: usbfs.Stream) -> None:
        if not stream.waiting:
            return
        urb, buffer, length, since = stream.waiting[0]
        now = time.monotonic()
        ready = self.falcon.reply and now >= self.ready_at
        if self._past("broken_after"):
            stream.waiting.pop(0)
            stream.finish(urb, -EPROTO, 0)
        elif ready or now - since >= self.falcon.latency_ms / 1e3:
            data = self.falcon.read(length if ready else 2)
            buffer.update(0, data)
            stream.waiting.pop(0)
            stream.finish(urb, 0, len(data))

    def answer(self, line: str) -> str:
        word, _, rest = line.partition(" ")
        if word == "displayed":
            return json.dumps(to_world((0.0, 0.0, 0.0) if self.lost else self.falcon.displayed))
        if word == "place":
            return json.dumps(self.falcon.at)
        node = os.path.join(self.bed.get_root_dir(), self.node_path.removeprefix("/"))
        if self.made == "not_found":
            self._add()
            self.bed.attach_ioctl(self.node_path, self.node)
            self.bed.uevent(f"/sys{self.device}", "add")
        elif self.made == "permission":
            os.chmod(node, 0o600)
        self.made = rest if word == "make" else ""
        if self.made == "not_found":
            self.bed.uevent(f"/sys{self.device}", "remove")
            self.bed.detach_ioctl(self.node_path)
            self.bed.remove_device(f"/sys{self.device}")
        elif self.made == "permission":
            os.chmod(node, 0)
        return "null"

    def seen(self) -> dict:
        return self.falcon.seen()

    def _serve(self, path: str) -> None:
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
                            into.append(self.answer(text))
                            flag.set()
                            return False

                        GLib.idle_add(ask, priority=GLib.PRIORITY_DEFAULT)
                        ready.wait()
                        stream.write(answers[0] + "\n")
                        stream.flush()

        threading.Thread(target=run, daemon=True).start()


if __name__ == "__main__":
    testbed.main(Bed)
