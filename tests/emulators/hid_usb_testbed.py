"""The emulated arm of testbed.py only on the USB bus, without a hidraw node, for hidapi's libusb backend.

The first argument is that of testbed.py, and also: block_after (reports until it accepts no more), claimed (true:
another program has its interface), listed (true: the system's table has a hidraw node that does not exist, as in a
container). This module is the kernel that libusb calls.
"""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from emulators import testbed

EAGAIN, EBUSY, EINVAL, ENODEV, ENODATA, ENOENT, ENOTTY, EPIPE, ESHUTDOWN = 11, 16, 22, 19, 61, 2, 25, 32, 108
# From <linux/usbdevice_fs.h>.
SUBMIT, DISCARD, REAP, REAP_NOW = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
CAPABILITIES, GET_DRIVER, CLAIM, RELEASE = 0x8004551A, 0x41045508, 0x8004550F, 0x80045510
CONTROL = 2
NODE = "/dev/bus/usb/001/002"
GET_DESCRIPTOR, STRING, REPORT = 6, 3, 0x22


class Stream:
    def __init__(self) -> None:
        self.done: list[object] = []
        self.waiting: list[tuple[object, object, int]] = []
        self.blocked: list[object] = []

    def finish(self, urb: object, status: int, actual: int) -> None:
        urb.update(4, struct.pack("<i", status))
        urb.update(28, struct.pack("<i", actual))
        self.done.append(urb)


class UsbBed(testbed.Bed):
    node_path = NODE

    def _wire(self) -> None:
        self.streams: dict[int, Stream] = {}
        self.bed = testbed.UMockdev.Testbed.new()
        vendor, product = self.ids
        blob = self._descriptors().hex().upper()
        names = f"BUSNUM=001 DEVNUM=002 MAJOR=189 MINOR=1 SUBSYSTEM=usb DEVTYPE=usb_device DEVNAME={NODE}"
        attributes = (
            f"busnum=1 devnum=2 bConfigurationValue=1 bNumConfigurations=1 idVendor={vendor:04x} "
            f"idProduct={product:04x} bcdDevice=0100 speed=12 serial=SN42"
        )
        lines = [f"P: {testbed.DEVICE}", f"N: {NODE.removeprefix('/dev/')}={blob}"]
        lines += [f"E: {one}" for one in names.split()] + [f"A: {one}\\n" for one in attributes.split()]
        self.bed.add_from_string("\n".join([*lines, f"A: product={self.name}\\n", f"H: descriptors={blob}", ""]))
        if self.case.get("listed"):
            for text in self.hidraw_table()[1:]:
                self.bed.add_from_string(text.replace("N: hidraw0\n", "").replace("N: hidraw1\n", ""))
        self.node = testbed.UMockdev.IoctlBase()
        self.node.connect("handle-ioctl", self._ioctl)
        self.bed.attach_ioctl(NODE, self.node)

    def _descriptors(self) -> bytes:
        body = b""
        for n, one in enumerate(self.board.interfaces):
            ends = bytes([7, 5, one.end_in, 3, one.bytes_in, 0, 1, 7, 5, one.end_out, 3, one.bytes_out, 0, 1])
            hid = bytes([9, 0x21, 0x11, 1, 0, 1, REPORT]) + struct.pack("<H", len(self._report(n)))
            body += bytes([9, 4, n, 0, 2, 3, 0, 0, 0]) + hid + ends
        device = bytes([18, 1, 0, 2, 0, 0, 0, 64]) + struct.pack("<HHH", *self.ids, 0x0100) + bytes([1, 2, 3, 1])
        return (
            device
            + bytes([9, 2])
            + struct.pack("<H", 9 + len(body))
            + bytes([len(self.board.interfaces), 1, 0, 0x80, 45])
            + body
        )

    def _report(self, interface: int) -> bytes:
        return self.descriptor if interface == self.board.arm else self.board.interfaces[interface].descriptor

    def _ioctl(self, _: object, client: object) -> bool:
        request, argument, code = client.get_request(), client.get_arg(), 0
        stream = self.streams.setdefault(hash(client), Stream())
        if request == CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", 7))
        elif request == CLAIM:
            code = -EBUSY if self.case.get("claimed") else 0
        elif request == RELEASE:
            del self.streams[hash(client)]
        elif request == GET_DRIVER:
            code = -ENODATA
        elif request == SUBMIT:
            code = self._submit(stream, argument)
        elif request in (REAP, REAP_NOW):
            code = self._reap(stream, argument)
        elif request == DISCARD:
            code = self._discard(stream)
        else:
            code = -ENOTTY
        client.complete(-1 if code else 0, -code)
        return True

    def _submit(self, stream: Stream, argument: object) -> int:
        if self._past("lost_after"):
            return -ENODEV
        urb = argument.resolve(0, 56)
        raw = bytes(urb.retrieve())
        kind, end = raw[0], raw[1]
        length = struct.unpack_from("<i", raw, 24)[0]
        buffer = urb.resolve(16, length) if length else None
        if kind == CONTROL:
            self._control(stream, urb, buffer)
        elif end == self.board.interfaces[self.board.arm].end_in:
            stream.waiting.append((urb, buffer, length))
        elif end & 0x80:  # of an interface without reports
            stream.blocked.append(urb)
        elif end != self.board.interfaces[self.board.arm].end_out:
            self.astray += 1
            stream.finish(urb, 0, length)
        elif self._past("block_after"):
            stream.blocked.append(urb)
        else:
            self.take(b"\0" + bytes(buffer.retrieve())[:length])
            stream.finish(urb, 0, length)
        return 0

    def _control(self, stream: Stream, urb: object, buffer: object) -> None:
        _, request, value, index, length = struct.unpack_from("<BBHHH", bytes(buffer.retrieve()))
        texts = {1: "Emulated", 2: self.name, 3: "SN42"}
        strings = {n: bytes([2 + 2 * len(t), STRING]) + t.encode("utf-16le") for n, t in texts.items()}
        answers = {
            (STRING, 0): bytes([4, STRING, 9, 4]),
            (REPORT, 0): self._report(index if index < len(self.board.interfaces) else 0),
        }
        answers |= {(STRING, n): text for n, text in strings.items()}
        answer = answers.get((value >> 8, value & 255))
        if request != GET_DESCRIPTOR or answer is None:
            stream.finish(urb, -EPIPE, 0)
            return
        answer = answer[:length]
        buffer.update(8, answer)
        stream.finish(urb, 0, len(answer))

    def _reap(self, stream: Stream, argument: object) -> int:
        lost = self._past("lost_after")
        if lost:
            for urb in [one[0] for one in stream.waiting] + stream.blocked:
                stream.finish(urb, -ESHUTDOWN, 0)
            stream.waiting, stream.blocked = [], []
        elif stream.waiting and self.queue:
            urb, buffer, length = stream.waiting.pop(0)
            data = self.queue.pop(0)[:length]
            buffer.update(0, data)
            stream.finish(urb, 0, len(data))
        if not stream.done:
            return -ENODEV if lost else -EAGAIN
        argument.resolve(0, 8).set_ptr(0, stream.done.pop(0))
        return 0

    def _discard(self, stream: Stream) -> int:
        # umockdev does not expose which one is meant: writes time out after a second, and reads are discarded when the
        # device is closed.
        given_up, stream.blocked = stream.blocked, []
        if not given_up:
            given_up, stream.waiting = [one[0] for one in stream.waiting], []
        for urb in given_up:
            stream.finish(urb, -ENOENT, 0)
        return 0 if given_up else -EINVAL


if __name__ == "__main__":
    result = testbed.main(UsbBed)
    sys.stdout.flush()
    os._exit(result)  # umockdev's threads would block the exit of the process
