"""The kernel's USB file system, as libusb calls it, for a device of umockdev. A subclass is the device."""

import struct
import time
from collections.abc import Iterable

EAGAIN, EBUSY, EINVAL, ENODEV, ENODATA, ENOENT, ENOTTY, ESHUTDOWN = 11, 16, 22, 19, 61, 2, 25, 108
# From <linux/usbdevice_fs.h>.
SUBMIT, DISCARD, REAP, REAP_NOW = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
CAPABILITIES, GET_DRIVER, CLAIM, RELEASE = 0x8004551A, 0x41045508, 0x8004550F, 0x80045510
SET_CONFIGURATION, RESET, CLEAR_HALT, SET_INTERFACE = 0x80045505, 0x5514, 0x80045515, 0x80085504
CONTROL = 2
BULK = 0xC0185502


def strings(*texts: str) -> dict[int, bytes]:
    """Return string descriptors by index; 0 is the language."""
    return {0: bytes([4, 3, 9, 4])} | {
        n: bytes([2 + 2 * len(text), 3]) + text.encode("utf-16le") for n, text in enumerate(texts, 1)
    }


def descriptors(ids: tuple[int, int], release: int, packet: int, interfaces: int, body: bytes) -> bytes:
    """Return the device and its configuration with the descriptors `body` of interfaces and endpoints."""
    device = bytes([18, 1, 0, 2, 0, 0, 0, packet]) + struct.pack("<HHH", *ids, release) + bytes([1, 2, 3, 1])
    return device + bytes([9, 2]) + struct.pack("<H", 9 + len(body)) + bytes([interfaces, 1, 0, 0x80, 45]) + body


def device_text(device: str, path: str, blob: bytes, properties: Iterable[str], attributes: Iterable[str]) -> str:
    data = blob.hex().upper()
    lines = [f"P: {device}", f"N: {path.removeprefix('/dev/')}={data}", f"E: DEVNAME={path}"]
    lines += [f"E: {word}" for word in properties] + [f"A: {word}\\n" for word in attributes]
    return "\n".join([*lines, f"H: descriptors={data}", ""])


class Stream:
    """Requests of one opening of the node: the kernel returns each only to its own opening."""

    def __init__(self) -> None:
        self.completed: list[object] = []
        self.waiting: list[tuple[object, object, int, float]] = []
        """Transfers in: URB, buffer, length, time of the request."""
        self.blocked: list[object] = []

    def finish(self, urb: object, status: int, actual: int) -> None:
        urb.update(4, struct.pack("<i", status))
        urb.update(28, struct.pack("<i", actual))
        self.completed.append(urb)

    def end(self, urbs: list[object], status: int) -> None:
        for urb in urbs:
            self.finish(urb, status, 0)


class UsbDevice:
    lost = False

    def claim(self, stream: Stream) -> bool:
        raise NotImplementedError

    def release(self, stream: Stream) -> None:
        pass

    def power_off(self) -> None:
        pass

    def control(self, stream: Stream, urb: object, buffer: object) -> None:
        raise NotImplementedError

    def transfer(self, stream: Stream, urb: object, end: int, buffer: object, length: int) -> None:
        raise NotImplementedError

    def bulk(self, end: int, data: bytes) -> None:
        """Receive the data of a transfer that its program waits for."""
        raise NotImplementedError

    def deliver(self, stream: Stream) -> None:
        """Finish waiting transfers for which there are data."""
        raise NotImplementedError

    def handle_ioctl(self, _: object, client: object) -> bool:
        request, argument, code = client.get_request(), client.get_arg(), 0
        streams = self.__dict__.setdefault("streams", {})
        stream = streams.setdefault(hash(client), Stream())
        if request == CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", 7))
        elif request == CLAIM:
            code = 0 if self.claim(stream) else -EBUSY
        elif request == RELEASE:
            # Pending requests end when the node is closed, which umockdev does not report.
            self.release(stream)
            del streams[hash(client)]
        elif request == GET_DRIVER:
            code = -ENODATA
        elif request == SUBMIT:
            code = self._submit(stream, argument)
        elif request == BULK:
            end, length = struct.unpack_from("<II", bytes(argument.resolve(0, 24).retrieve()))
            self.bulk(end, bytes(argument.resolve(0, 24).resolve(16, length).retrieve()))
            client.complete(length, 0)
            return True
        elif request in (REAP, REAP_NOW):
            code = self._reap(stream, argument)
        elif request == DISCARD:
            code = self._discard(stream)
        elif request not in (SET_CONFIGURATION, RESET, CLEAR_HALT, SET_INTERFACE):
            code = -ENOTTY
        client.complete(-1 if code else 0, -code)
        return True

    def _submit(self, stream: Stream, argument: object) -> int:
        if self.lost:
            self.power_off()
            return -ENODEV
        urb = argument.resolve(0, 56)
        raw = bytes(urb.retrieve())
        length = struct.unpack_from("<i", raw, 24)[0]
        buffer = urb.resolve(16, length) if length else None
        if raw[0] == CONTROL:
            self.control(stream, urb, buffer)
        else:
            self.transfer(stream, urb, raw[1], buffer, length)
        return 0

    def _reap(self, stream: Stream, argument: object) -> int:
        if self.lost:
            self.power_off()
            stream.end([request[0] for request in stream.waiting] + stream.blocked, -ESHUTDOWN)
            stream.waiting, stream.blocked = [], []
        else:
            self.deliver(stream)
        if not stream.completed:
            return -ENODEV if self.lost else -EAGAIN
        argument.resolve(0, 8).set_ptr(0, stream.completed.pop(0))
        return 0

    def _discard(self, stream: Stream) -> int:
        # umockdev does not expose which one is meant: writes time out first, and reads are discarded when the device is
        # closed.
        given_up, stream.blocked = stream.blocked, []
        if not given_up:
            given_up, stream.waiting = [request[0] for request in stream.waiting], []
        stream.end(given_up, -ENOENT)
        return 0 if given_up else -EINVAL


def wait(stream: Stream, urb: object, buffer: object, length: int) -> None:
    """Queue a transfer in."""
    stream.waiting.append((urb, buffer, length, time.monotonic()))
