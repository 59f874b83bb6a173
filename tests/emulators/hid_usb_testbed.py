"""The emulated arm of testbed.py only on the USB bus, without a hidraw node, for hidapi's libusb backend.

The first argument is that of testbed.py, and also: block_after (reports until it accepts no more), claimed (true:
another program has its interface), listed (true: the system's table has a hidraw node that does not exist, as in a
container), kill_after (reports until the program is killed). This module is the kernel that libusb calls.
"""

import struct
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from emulators import testbed, usbfs

EPIPE = 32
NODE = "/dev/bus/usb/001/002"
GET_DESCRIPTOR, STRING, REPORT = 6, 3, 0x22


class UsbBed(usbfs.UsbDevice, testbed.Bed):
    node_path = NODE

    def _wire(self) -> None:
        self.bed = testbed.UMockdev.Testbed.new()
        vendor, product = self.ids
        names = "BUSNUM=001 DEVNUM=002 MAJOR=189 MINOR=1 SUBSYSTEM=usb DEVTYPE=usb_device"
        attributes = (
            f"busnum=1 devnum=2 bConfigurationValue=1 bNumConfigurations=1 idVendor={vendor:04x} "
            f"idProduct={product:04x} bcdDevice=0100 speed=12 serial=SN42"
        )
        listed = [*attributes.split(), f"product={self.name}"]
        self.bed.add_from_string(usbfs.device_text(testbed.DEVICE, NODE, self._descriptors(), names.split(), listed))
        if self.case.get("listed"):
            for text in self.hidraw_table()[1:]:
                self.bed.add_from_string(text.replace("N: hidraw0\n", "").replace("N: hidraw1\n", ""))
        self.node = testbed.UMockdev.IoctlBase()
        self.node.connect("handle-ioctl", self.handle_ioctl)
        self.bed.attach_ioctl(NODE, self.node)

    def _descriptors(self) -> bytes:
        body = b""
        for n, part in enumerate(self.board.interfaces):
            ends = bytes([7, 5, part.end_in, 3, part.bytes_in, 0, 1, 7, 5, part.end_out, 3, part.bytes_out, 0, 1])
            hid = bytes([9, 0x21, 0x11, 1, 0, 1, REPORT]) + struct.pack("<H", len(self._report(n)))
            body += bytes([9, 4, n, 0, 2, 3, 0, 0, 0]) + hid + ends
        return usbfs.descriptors(self.ids, 0x0100, 64, len(self.board.interfaces), body)

    def _report(self, interface: int) -> bytes:
        return self.descriptor if interface == self.board.arm else self.board.interfaces[interface].descriptor

    @property
    def lost(self) -> bool:
        return self._past("lost_after")

    def claim(self, stream: usbfs.Stream) -> bool:
        return not self.case.get("claimed")

    def transfer(self, stream: usbfs.Stream, urb: object, end: int, buffer: object, length: int) -> None:
        arm = self.board.interfaces[self.board.arm]
        if end == arm.end_in:
            usbfs.wait(stream, urb, buffer, length)
        elif end & 0x80:  # of an interface without reports
            stream.blocked.append(urb)
        elif end != arm.end_out:
            self.astray += 1
            stream.finish(urb, 0, length)
        elif self._past("block_after"):
            stream.blocked.append(urb)
        else:
            self.take(b"\0" + bytes(buffer.retrieve())[:length])
            stream.finish(urb, 0, length)
            if self._past("kill_after") and any(self.woody.sent[-1][:3]):
                self.process.kill()

    def bulk(self, end: int, data: bytes) -> None:
        arm = self.board.interfaces[self.board.arm]
        self.astray += end != arm.end_out or len(data) != arm.bytes_out
        self.take(b"\0" + data)

    def control(self, stream: usbfs.Stream, urb: object, buffer: object) -> None:
        _, request, value, index, length = struct.unpack_from("<BBHHH", bytes(buffer.retrieve()))
        answers = {(STRING, n): text for n, text in usbfs.strings("Emulated", self.name, "SN42").items()}
        answers[REPORT, 0] = self._report(index if index < len(self.board.interfaces) else 0)
        answer = answers.get((value >> 8, value & 255))
        if request != GET_DESCRIPTOR or answer is None:
            stream.finish(urb, -EPIPE, 0)
            return
        answer = answer[:length]
        buffer.update(8, answer)
        stream.finish(urb, 0, len(answer))

    def deliver(self, stream: usbfs.Stream) -> None:
        if stream.waiting and self.queue:
            urb, buffer, length, _ = stream.waiting.pop(0)
            data = self.queue.pop(0)[:length]
            buffer.update(0, data)
            stream.finish(urb, 0, len(data))


if __name__ == "__main__":
    testbed.main(UsbBed)
