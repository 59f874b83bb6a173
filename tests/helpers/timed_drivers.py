"""Drivers on test doubles without a bus, for measurements of their times (`tests/driver_times.py`)."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from emulators.puck import combined
from emulators.serialboard import FRAME_BYTES, Board
from numpy.typing import NDArray

from helpers import drd_stub, haply_devices, hd_stub, usb_stub
from helpers.c_stub import compile_stub
from helpers.hid_devices import ends
from helpers.rig_files import rig_options
from softfinger.drivers.base import Device, DeviceIO
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.device import open_device as open_falcon
from softfinger.drivers.forcedimension import device as forcedimension
from softfinger.drivers.forcedimension.exchange import AT as FD
from softfinger.drivers.hid.device import HidDevice
from softfinger.drivers.hid.link import ReportLink
from softfinger.drivers.openhaptics.device import open_device as open_touch
from softfinger.drivers.openhaptics.options import Options as TouchOptions
from softfinger.drivers.serial.device import SerialDevice
from softfinger.drivers.spacemouse.device import SpaceMouse
from softfinger.drivers.spacemouse.puck import Options as PuckOptions
from softfinger.drivers.system.libc import IO_SIGNATURE, read_fd, write_fd
from softfinger.proxy.kernels.jit.foreign import call_int32
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller

Array = NDArray[np.float64]

BUFFER: Final = 128
"""Bytes; the longest report on a packet socket here has 65."""
WAKE_S: Final = 0.2


class Case(NamedTuple):
    """Measured driver.

    io, bare  C functions and handle of the driver, and of the bare calls
    peer      file descriptor of the device's end of a packet socket, -1 if there is none
    answer    data that the device sends before each tick, bytes
    wake      resumes the driver if the loop was delayed and the driver waits for a current answer
    wait_ns   time before each tick in which a thread of the driver receives the next sample
    """

    io: DeviceIO
    bare: DeviceIO
    peer: int = -1
    answer: bytes = b""
    wake: Callable[[], object] = lambda: None
    wait_ns: int = 0


class End(NamedTuple):
    """A device, and the received forces (k, 2): s of the monotonic clock, N along z. Its x is the clock's fraction."""

    device: Device
    received_forces: Callable[[], Array]


# The same calls without the driver. Their handle is the driver's block for a library; for a file it is the address of
# the file descriptor, of the address of a buffer, and of the number of bytes to write.


@numba.cfunc(IO_SIGNATURE)
def _library_read(handle, sample):
    word = int64_at(handle)
    at = handle + 8 * FD.frame
    device = np.int32(word[FD.id])
    code = call_int32(
        word[FD.get_frame], (float64_at(at), float64_at(at + 8), float64_at(at + 16), float64_at(at + 24), device)
    )
    return code + call_int32(word[FD.get_buttons], (device,))


@numba.cfunc(IO_SIGNATURE)
def _library_write(handle, wrench):
    word = int64_at(handle)
    device = np.int32(word[FD.id])
    return call_int32(
        word[FD.set_wrench], (wrench[0], wrench[1], wrench[2], wrench[3], wrench[4], wrench[5], 0.0, device)
    )


@numba.cfunc(IO_SIGNATURE)
def _libusb_read(handle, sample):
    """The driver's transfers are used: a reply received here is one the driver awaits and vice versa."""
    word = int64_at(handle)
    word[AT.timespec], word[AT.timespec + 1] = 0, 0
    arguments = (word[AT.context], int64_at(handle + 8 * AT.timespec), int64_at(0))
    call_int32(word[AT.handle_events], arguments)
    call_int32(word[AT.submit], (word[AT.transfer_in],))
    return call_int32(word[AT.handle_events], arguments)


@numba.cfunc(IO_SIGNATURE)
def _libusb_write(handle, wrench):
    word = int64_at(handle)
    return call_int32(word[AT.submit], (word[AT.transfer_out],))


@numba.cfunc(IO_SIGNATURE)
def _packet_read(handle, sample):
    """Read a report, then find no other."""
    word = int64_at(handle)
    read_fd(word[0], word[1], BUFFER)
    return read_fd(word[0], word[1], BUFFER)


@numba.cfunc(IO_SIGNATURE)
def _stream_read(handle, sample):
    word = int64_at(handle)
    return read_fd(word[0], word[1], BUFFER)


@numba.cfunc(IO_SIGNATURE)
def _file_write(handle, wrench):
    word = int64_at(handle)
    return write_fd(word[0], word[1], word[2])


@numba.cfunc(IO_SIGNATURE)
def _nothing(handle, values):
    return 0


@contextmanager
def bare_file(read: Any, write: Any, fd: int, sent_bytes: int) -> Iterator[DeviceIO]:
    """Calls of a file descriptor, with a buffer whose first word is 1."""
    buffer = np.ones(BUFFER // 8, np.int64)
    words = np.array([fd, buffer.ctypes.data, sent_bytes])
    yield DeviceIO(read.address, write.address, words.ctypes.data)


@contextmanager
def force_dimension(folder: Path) -> Iterator[Case]:
    """An omega.6 on the stub of libdrd."""
    path = compile_stub(drd_stub.SOURCE, folder / "libdrd.so.3.17.5")
    drd_stub.Stub(path).update(type=34, wrist=1)
    options = forcedimension.Options(library_file=str(path), watchdog_s=0.0)  # compilation would trigger it
    with forcedimension.open_device(options, RATE_HZ) as device:
        device.arm()
        io = device.io()
        yield Case(io, DeviceIO(_library_read.address, _library_write.address, io.handle))


@contextmanager
def falcon(folder: Path) -> Iterator[Case]:
    """A Falcon on the stub of libusb with a moving knob, so that its position is computed in each tick."""
    path = compile_stub(usb_stub.SOURCE, folder / usb_stub.SONAME)
    stub = usb_stub.UsbStub(path)
    stub.update(press=0.006, drag=0.02)
    with usb_stub.in_place_of_libusb(path), open_falcon(usb_stub.options(), RATE_HZ) as device:
        stub["logged"] = 1e9  # the stub's log is full
        device.arm()
        io = device.io()
        yield Case(io, DeviceIO(_libusb_read.address, _libusb_write.address, io.handle))


def answered(end: socket.socket, answer: bytes, exchange: Callable[[], Any]) -> Any:
    """Return the result of an exchange; its first request is answered."""

    def once() -> None:
        with suppress(TimeoutError):
            end.recv(BUFFER)
            end.send(answer)

    end.settimeout(WAKE_S)
    thread = threading.Thread(target=once)
    thread.start()
    result = exchange()
    thread.join()
    end.setblocking(False)
    return result


@contextmanager
def on_socket(device: Any, end: socket.socket, answer: bytes, bare: DeviceIO) -> Iterator[Case]:
    """A board on a socket, which answers each frame."""
    wake = partial(answered, end, answer, DeviceCaller(device, arm=False).read)
    yield Case(device.io(), bare, end.fileno(), answer, wake)


@contextmanager
def hid(_: Path) -> Iterator[Case]:
    options = rig_options("woodenhaptics-2019", calibrate=False)
    fd, end = ends()
    answer, sent = bytes(options.reports.input.bytes), 1 + options.reports.output.bytes
    with (
        end, HidDevice(options, ReportLink(fd)) as device, bare_file(_packet_read, _file_write, fd, sent) as bare,
        on_socket(device, end, answer, bare) as case,
    ):  # fmt: skip
        yield case


@contextmanager
def serial(_: Path) -> Iterator[Case]:
    """A WoodenHaptics of the third generation on a stream socket, which passes bytes like a port."""
    answer, options = Board(lambda _: (0.01, 0.02, -0.015)).frame(), rig_options("woodenhaptics-v3")
    near, far = socket.socketpair()
    near.setblocking(False)
    with far, answered(far, answer, lambda: SerialDevice(options, near.detach(), "a socket")) as device:
        fd = int(device._block.word[BOARD.fd])
        with (
            bare_file(_stream_read, _file_write, fd, FRAME_BYTES) as bare,
            on_socket(device, far, answer, bare) as case,
        ):
            yield case


@contextmanager
def spacemouse(_: Path) -> Iterator[Case]:
    """A puck on a packet socket, with a report in each tick; writes are discarded."""
    fd, end = ends()
    end.setblocking(False)
    with (
        end, SpaceMouse(PuckOptions(), fd, RATE_HZ) as device, bare_file(_packet_read, _nothing, fd, 0) as bare
    ):  # fmt: skip
        yield Case(device.io(), bare, end.fileno(), combined(right=100)[0])


@contextmanager
def haply(_: Path) -> Iterator[Case]:
    """An Inverse3 on the emulated service; its thread receives the next state 0.5 ms before each tick."""
    waker, ended = os.eventfd(0), threading.Event()

    def sleeper() -> None:
        while not ended.is_set():
            os.eventfd_read(waker)

    with (
        haply_devices.Service() as service, haply_devices.opened(service) as device,
        bare_file(_nothing, _file_write, waker, 8) as bare,
    ):  # fmt: skip
        woken = threading.Thread(target=sleeper)
        woken.start()
        device.arm()
        yield Case(device.io(), bare, wait_ns=500_000)
        ended.set()
        os.eventfd_write(waker, 1)
        woken.join()
    os.close(waker)


@contextmanager
def two_inverse3(_: Path) -> Iterator[list[End]]:
    """Two Inverse3 on one emulated Inverse Service, each with its own thread and session."""
    names = ("049D", "0A11")
    with haply_devices.Service(devices=tuple(f"inverse3:{name}" for name in names)) as service, ExitStack() as undo:
        found = []
        for name in names:
            service.do("move", id=name, to="clock")
            device = undo.enter_context(haply_devices.opened(service, device_id=name, mounting={}))
            found.append(End(device, lambda name=name: np.array(service.log(name))[:, [0, 3]]))
        yield found


@contextmanager
def touch(folder: Path) -> Iterator[list[End]]:
    """A Touch on the stub of libHD; its thread calls the driver once per millisecond."""
    stub = hd_stub.HdStub(compile_stub(hd_stub.SOURCE, folder / "libHD.so.3.4.0", "-pthread"))
    stub["clock"] = 1.0

    def received_forces() -> Array:
        rows = stub.journal()
        return np.column_stack([rows["ns"] * 1e-9, rows["force"][:, 1]])  # up is the library's y

    with open_touch(TouchOptions(library_file=str(stub.path)), RATE_HZ) as device:
        yield [End(device, received_forces)]


COST_CASES: Final[dict[str, Callable[[Path], AbstractContextManager[Case]]]] = {
    "forcedimension": force_dimension, "falcon": falcon, "haply": haply, "hid": hid, "serial": serial,
    "spacemouse": spacemouse,
}  # fmt: skip
AGE_CASES: Final[dict[str, Callable[[Path], AbstractContextManager[list[End]]]]] = {
    "haply": two_inverse3, "openhaptics": touch
}  # fmt: skip
ON_STUBS: Final = ("forcedimension", "falcon", "openhaptics")
"""Drivers whose double is compiled."""
