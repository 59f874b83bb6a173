"""Time of a driver's tick in addition to its C calls: `python tests/exchange_cost.py`, `make exchange-cost`.

For each hardware driver a device is opened on a stub: Force Dimension's and a Touch on stubs of the makers' libraries,
the Falcon on a stub of libusb, HID devices and the puck on a packet socket, serial boards on a stream socket, Haply's
on an emulated service. A compiled loop times read and write of the driver, called like in the servo, alternating with
the same C calls without the driver, with the same arguments on the same stub, so that the caches are warm. The driver's
own time is the difference of the medians; its range is that over twenty parts of the run. The time of the stub is part
of both.
"""

from __future__ import annotations

import argparse
import os
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from emulators.puck import combined
from emulators.serialboard import FRAME_BYTES, Board
from helpers.c_stub import COMPILER, NO_COMPILER, compile_stub
from helpers.described_boards import rig_options as described_options
from helpers.drd_stub import SOURCE, Stub
from helpers.haply_devices import Service
from helpers.haply_devices import opened as open_haply
from helpers.hd_stub import SOURCE as HD_SOURCE
from helpers.hid_devices import ends, rig_options
from helpers.serial_devices import rig_options as serial_options
from helpers.usb_stub import SONAME, UsbStub, in_place_of_libusb
from helpers.usb_stub import SOURCE as USB_SOURCE
from helpers.usb_stub import options as falcon_options
from numpy.typing import NDArray

from softfinger.config.errors import DeviceTimeout, HapticError
from softfinger.drivers.base import OK, SAMPLE_SIZE, DeviceIO
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.device import open_device as open_falcon
from softfinger.drivers.forcedimension import device as forcedimension
from softfinger.drivers.forcedimension.exchange import AT as FD
from softfinger.drivers.hid.device import HidDevice
from softfinger.drivers.openhaptics.device import open_device as open_touch
from softfinger.drivers.openhaptics.options import Options as TouchOptions
from softfinger.drivers.serial.device import SerialDevice
from softfinger.drivers.serial.packets import complete_frame, make_shape
from softfinger.drivers.spacemouse.device import SpaceMouse
from softfinger.drivers.spacemouse.puck import Options as PuckOptions
from softfinger.drivers.system.libc import IO_SIGNATURE, read_fd, write_fd
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.proxy.kernels.jit.foreign import call_int32
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller
from softfinger.server.loop.clock import read_clock_ns, sleep_until
from softfinger.server.offline.figures import make_figure, save
from softfinger.tools import measure
from softfinger.tools.options import add_output_options

PARTS: Final = 20
BUFFER: Final = 128
"""Bytes; the longest report on a packet socket here has 65."""
TRIES: Final = 100
WAKE_S: Final = 0.2
COLUMNS: Final = ("driver", "bare", "own", "least", "most")
FORCE: Final = (0.1, -0.2, 0.3)


class Case(NamedTuple):
    """Driver to be measured.

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
    wake: Callable[[], None] = lambda: None
    wait_ns: int = 0


@numba.njit(**OPTIONS)
def _tick(io: DeviceIO, sample: Any, wrench: Any, timespec: Any) -> tuple[int, int]:
    """Time (ns) and status of one tick: OK after a new sample and a complete write, negative after an error."""
    begun = read_clock_ns(timespec)
    status = call_device(io.read, io.handle, sample)
    written = call_device(io.write, io.handle, wrench)
    return read_clock_ns(timespec) - begun, status if status < 0 else max(status, written)


@numba.njit(**OPTIONS)
def _measure(calls: Any, peer: int, wait_ns: int, report: Any, memory: Any, out: Any, whole: Any) -> int:
    """Measure driver and direct `calls` alternately into `out` (n, 2) ns; return n, or the tick of a failure."""
    sample, wrench, timespec, buffer = memory
    io, bare = calls
    for n in range(len(out)):
        for series in range(2):
            if peer >= 0:
                while read_fd(peer, buffer.ctypes.data, BUFFER) > 0:
                    pass
                write_fd(peer, report.ctypes.data, len(report))
            if wait_ns > 0:
                sleep_until(read_clock_ns(timespec) + wait_ns, timespec)
            out[n, series], status = _tick(io if series == 0 else bare, sample, wrench, timespec)
            if series == 0:
                whole[n] = status == OK
                if status < 0:
                    return n
    return len(out)


# The same calls without the driver. A handle is the address of the words named in each docstring.


@numba.cfunc(IO_SIGNATURE)
def _library_read(handle, sample):
    """The driver's block: addresses of its functions, and its buffers."""
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
    """The driver's block, whose transfers are used: a reply received here is one the driver awaits and vice versa."""
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
def _socket_read(handle, sample):
    """File descriptor, address of a buffer, bytes of a report. Reads a report, then finds no other."""
    word = int64_at(handle)
    read_fd(word[0], word[1], BUFFER)
    return read_fd(word[0], word[1], BUFFER)


@numba.cfunc(IO_SIGNATURE)
def _stream_read(handle, sample):
    word = int64_at(handle)
    return read_fd(word[0], word[1], BUFFER)


@numba.cfunc(IO_SIGNATURE)
def _socket_write(handle, wrench):
    word = int64_at(handle)
    return write_fd(word[0], word[1], word[2])


@numba.cfunc(IO_SIGNATURE)
def _nothing(handle, values):
    return 0


def answered(end: socket.socket, answer: bytes, exchange: Callable[[], Any]) -> Any:
    def once() -> None:
        with suppress(TimeoutError):
            end.recv(BUFFER)
            end.send(answer)

    end.settimeout(WAKE_S)
    thread = threading.Thread(target=once)
    thread.start()
    device = exchange()
    thread.join()
    end.setblocking(False)
    return device


@contextmanager
def force_dimension(folder: Path) -> Iterator[Case]:
    """An omega.6 on the stub of libdrd."""
    path = compile_stub(SOURCE, folder / "libdrd.so.3.17.5")
    Stub(path).update(type=34, wrist=1)
    options = forcedimension.Options(library_file=str(path), watchdog_s=0.0)  # compilation would trigger it
    with forcedimension.open_device(options, RATE_HZ) as device:
        device.arm()
        io = device.io()
        yield Case(io, DeviceIO(_library_read.address, _library_write.address, io.handle))


@contextmanager
def falcon(folder: Path) -> Iterator[Case]:
    """A Falcon on the stub of libusb with a moving knob, so that its position is computed in each tick."""
    path = compile_stub(USB_SOURCE, folder / SONAME)
    stub = UsbStub(path)
    stub.update(press=0.006, drag=0.02)
    with in_place_of_libusb(path), open_falcon(falcon_options(), RATE_HZ) as device:
        stub["logged"] = 1e9  # the stub's log is full
        device.arm()
        io = device.io()
        yield Case(io, DeviceIO(_libusb_read.address, _libusb_write.address, io.handle))


@contextmanager
def hid(_: Path) -> Iterator[Case]:
    options = rig_options("woodenhaptics-2019", calibrate=False)
    fd, end = ends()
    answer, buffer = bytes(options.reports.input.bytes), np.zeros(BUFFER, np.uint8)
    with end, HidDevice(options, fd) as device:
        words = np.array([fd, buffer.ctypes.data, 1 + options.reports.output.bytes])
        bare = DeviceIO(_socket_read.address, _socket_write.address, words.ctypes.data)
        yield Case(
            device.io(), bare, end.fileno(), answer, lambda: answered(end, answer, DeviceCaller(device, arm=False).read)
        )


@contextmanager
def on_stream(options: Any, answer: bytes, sent: int) -> Iterator[Case]:
    """A board on a stream socket, which passes bytes like a port, with frames of `sent` bytes from the driver."""
    near, far = socket.socketpair()
    near.setblocking(False)
    buffer = np.zeros(BUFFER, np.uint8)
    with far, answered(far, answer, lambda: SerialDevice(options, near.detach(), "a socket")) as device:
        words = np.array([int(device._block.word[BOARD.fd]), buffer.ctypes.data, sent])
        bare = DeviceIO(_stream_read.address, _socket_write.address, words.ctypes.data)
        yield Case(
            device.io(), bare, far.fileno(), answer, lambda: answered(far, answer, DeviceCaller(device, arm=False).read)
        )


def serial(_: Path) -> AbstractContextManager[Case]:
    """A WoodenHaptics of the third generation."""
    return on_stream(serial_options(), Board(lambda _: (0.01, 0.02, -0.015)).frame(), FRAME_BYTES)


def described(_: Path) -> AbstractContextManager[Case]:
    """A Hapkit, with frames and paddle described by its rig."""
    options = described_options("hapkit")
    assert options.frames is not None
    frame, shape = np.zeros(options.frames.input.bytes, np.uint8), make_shape(options.frames.input, False)
    complete_frame(frame.ctypes.data, shape.ctypes.data)
    return on_stream(options, frame.tobytes(), options.frames.output.bytes)


@contextmanager
def openhaptics(folder: Path) -> Iterator[Case]:
    """A Touch on the stub of libHD, whose thread calls the library: the loop makes no C calls."""
    path = compile_stub(HD_SOURCE, folder / "libHD.so.3.4.0", "-pthread")
    with open_touch(TouchOptions(library_file=str(path), force_age_max_s=0.1), RATE_HZ) as device:
        device.arm()
        io = device.io()
        yield Case(io, DeviceIO(_nothing.address, _nothing.address, io.handle), wait_ns=2_000_000)


@contextmanager
def spacemouse(_: Path) -> Iterator[Case]:
    """A puck on a packet socket, with a report in each tick; writes are discarded."""
    fd, end = ends()
    end.setblocking(False)
    buffer = np.zeros(BUFFER, np.uint8)
    with end, SpaceMouse(PuckOptions(), fd, RATE_HZ) as device:
        words = np.array([fd, buffer.ctypes.data, 0])
        bare = DeviceIO(_socket_read.address, _nothing.address, words.ctypes.data)
        yield Case(device.io(), bare, end.fileno(), combined(right=100)[0])


@contextmanager
def haply(_: Path) -> Iterator[Case]:
    """An Inverse3 on the emulated service, whose thread receives the next state 0.5 ms before each tick."""
    waker, increment, ended = os.eventfd(0), np.ones(1, np.int64), threading.Event()

    def sleeper() -> None:
        while not ended.is_set():
            os.eventfd_read(waker)

    with Service() as service, open_haply(service) as device:
        woken = threading.Thread(target=sleeper)
        woken.start()
        device.arm()
        words = np.array([waker, increment.ctypes.data, 8])
        yield Case(device.io(), DeviceIO(_nothing.address, _socket_write.address, words.ctypes.data), wait_ns=500_000)
        ended.set()
        os.eventfd_write(waker, 1)
        woken.join()
    os.close(waker)


CASES: Final[dict[str, Callable[[Path], AbstractContextManager[Case]]]] = {
    "forcedimension": force_dimension,
    "falcon": falcon,
    "haply": haply,
    "hid": hid,
    "serial": serial,
    "described": described,
    "openhaptics": openhaptics,
    "spacemouse": spacemouse,
}


def times(case: Case, ticks: int) -> tuple[NDArray[np.float64], float]:
    """Return seconds (n, 2) of each tick of driver and bare calls, and the fraction of complete ticks."""
    out = np.zeros((ticks, 2), np.int64)
    wrench = np.array([*FORCE, 0.0, 0.0, 0.0])
    memory = (np.zeros(SAMPLE_SIZE), wrench, np.zeros(2, np.int64), np.zeros(BUFFER, np.uint8))
    whole = np.zeros(ticks, np.bool_)
    report = np.frombuffer(case.answer, np.uint8).copy()
    for many in (1, ticks):  # the first call compiles
        count, tries = 0, 0
        while count < many:
            case.wake()
            count += _measure(
                (case.io, case.bare), case.peer, case.wait_ns, report, memory, out[count:many], whole[count:many]
            )
            tries += 1
            if tries > TRIES:
                raise DeviceTimeout(f"the driver failed in {tries} ticks of {count}: is this machine busy?")
    return out * 1e-9, float(np.mean(whole))


def result(seconds: NDArray[np.float64], whole: float) -> dict[str, Any]:
    """Return medians, their difference with its range over the run, s, and the fraction of complete ticks."""
    parts = [np.median(part, axis=0) for part in np.array_split(seconds, min(PARTS, len(seconds)))]
    between = [float(driver - bare) for driver, bare in parts]
    driver, bare = (float(value) for value in np.median(seconds, axis=0))
    own = driver - bare
    return {"driver": driver, "bare": bare, "own": own, "least": min(between), "most": max(between), "whole": whole}


def draw(results: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw a bar per driver: its own time, with the range over the parts."""
    drawing = make_figure()
    axes = drawing.subplots()
    own = np.array([[costs[key] for key in ("own", "least", "most")] for costs in results.values()]) * 1e6
    reach = np.abs(own[:, 1:] - own[:, :1]).T
    axes.barh(list(results), own[:, 0], xerr=reach, capsize=4)
    axes.set_xlabel("time of a tick minus that of the same C calls without the driver (us)")
    save(drawing, path)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--driver", choices=CASES, action="append", help="measure this one; any number of times")
    parser.add_argument("--ticks", type=int, default=100_000, metavar="N", help="of each kind (default: %(default)s)")
    add_output_options(parser)
    args = parser.parse_args()
    if args.ticks < 1:
        parser.error(f"--ticks {args.ticks}: must be 1 or more")
    try:
        results = {}
        for name in args.driver or CASES:
            if COMPILER is None and name in ("forcedimension", "falcon", "openhaptics"):
                print(f"{name}: left out: {NO_COMPILER}", file=sys.stderr)
                continue
            with tempfile.TemporaryDirectory() as folder, CASES[name](Path(folder)) as case:
                results[name] = result(*times(case, args.ticks))
    except HapticError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    rows = [
        f"{name:15}" + "".join(f"{costs[key] * 1e6:9.2f}" for key in COLUMNS) + f"{costs['whole']:12.1%}"
        for name, costs in results.items()
    ]
    head = f"{'us a tick':15}" + "".join(f"{word:>9}" for word in COLUMNS) + f"{'whole ticks':>12}"
    content = {"ticks": args.ticks, "seconds": results}
    return measure.show_and_draw(args, content, [head, *rows], lambda path: draw(results, path))


if __name__ == "__main__":
    sys.exit(main())
