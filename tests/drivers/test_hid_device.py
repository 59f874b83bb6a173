"""HID devices on a packet socket: pauses, faults, calibration, random reports, opening.

test_contract_at_far_ends.py has the contract.
"""

import contextlib
import fcntl
import os
import socket
import struct
import time
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulators.woodenhaptics import Arm, Woody
from helpers.hid_devices import RIGS, Answering, described, ends, rig_options, woody
from helpers.waits import repeated

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceTimeout
from softfinger.config.load import build
from softfinger.drivers.base import LOST, OK, SAMPLE_SIZE
from softfinger.drivers.hid.device import HidDevice, Options, open_device
from softfinger.drivers.hid.report_threads import QUEUE_BYTES
from softfinger.drivers.system.libc import write_fd
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.memory import uint8_at
from softfinger.server.driver_contract import DeviceCaller

pytestmark = pytest.mark.real_time

COUNT_M = 3e-4
"""Half an encoder count at a motor is up to 0.13 mm at the end of the longest arm along each joint."""


def test_a_board_that_sends_continuously() -> None:
    """Firmware of woody-experimental reports in each USB frame: after a second without reads the sample is current."""
    arm = Woody("woody-2015", 1, lambda _: (0.01, 0.0, 0.0))
    fd, end = ends()
    end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE_BYTES)

    def hear(report: bytes) -> None:
        arm.answer(report)

    def speak() -> None:
        with contextlib.suppress(OSError):  # the system's queue is full, or the driver has closed its end
            end.send(arm.report(), socket.MSG_DONTWAIT)

    with (
        Answering(end, hear) as answering,
        repeated(speak, every_s=0.001),
        HidDevice(rig_options("woodenhaptics-2015", timeout_s=0.5), fd) as device,
    ):
        time.sleep(1.0)
        arm.place = (0.0, 0.02, 0.01)
        device.arm()
        servo = DeviceCaller(device)
        status, sample = servo.read()
        assert status >= 0
        np.testing.assert_allclose(sample[:3], arm.place, atol=2e-3)  # a few steps of the pulled arm, and a count
        for _ in range(50):
            time.sleep(0.001)
            servo.read()
            servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        answering.settle(device)
        force = arm.arm.force(arm.place, tuple(i / 1e3 for i in arm.milliamperes))
        np.testing.assert_allclose(force, (0.0, 0.0, 1.0), atol=0.012)
        assert device.counts()["reports"] > 30


def test_minutes_between_opening_and_the_first_tick() -> None:
    with woody() as (device, arm, answering):
        servo = DeviceCaller(device)
        servo.read()
        old = arm.report()
        for _ in range(30):
            answering.end.send(old)
        arm.place = (0.03, 0.0, 0.02)
        device.arm()
        status, sample = servo.read()
        assert status >= 0
        np.testing.assert_allclose(sample[:3], arm.place, atol=2e-3)  # a step of the pulled arm, and a count
        assert not any(any(words[:3]) for words in arm.sent)
        answering.mute.set()
        with pytest.raises(DeviceTimeout, match="sends no report"):
            device.arm()


def test_unplugging_is_a_loss() -> None:
    with woody() as (device, _, answering):
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        answering.unplug()
        assert servo.read()[0] == LOST and servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == LOST
        device.stop()
        assert device.zero_failure() == "its node accepts no report"
        device.close()
        assert servo.read()[0] == LOST


def test_the_last_report_ends_the_force() -> None:
    with woody() as (device, arm, answering):
        assert device.last_word() is None
        device._node = "/dev/hidraw7"
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        answering.settle(device)
        assert any(arm.sent[-1])
        node, fd, zero = device.last_word()
        assert node == "/dev/hidraw7" and os.fstat(fd)
        arm.answer(zero)
        assert not any(arm.sent[-1])


def test_calibration_of_a_board_that_pauses() -> None:
    options = rig_options("woodenhaptics-polhem-v1", calibrate=True, timeout_s=0.2)  # a busy machine answers late
    itself = Arm(RIGS["woodenhaptics-polhem-v1"])
    resting = itself.position(itself.angles_at(itself.calibration))
    arm = Woody(RIGS["woodenhaptics-polhem-v1"], 2, lambda _: resting)
    arm.zero = (321, -123, 77)
    stored: list[float] = []

    def answer(data: bytes) -> bytes | None:
        reply = arm.answer(data)
        if arm.zero == (0, 0, 0) and not stored:
            stored.append(time.monotonic() + 2.0 * options.timeout_s)
        return None if stored and time.monotonic() < stored[0] else reply

    fd, end = ends()
    with Answering(end, answer), HidDevice(options, fd) as device:
        assert time.monotonic() >= stored[0]
        np.testing.assert_allclose(DeviceCaller(device).read()[1][:3], resting, atol=COUNT_M)
        assert device.info.sensed_dof == 6  # with its wrist


@entry
def fuzz(fd: int, read: int, handle: int, stream: int, sizes: Any, sample: Any, out: Any) -> None:
    """Read after each report of `sizes` (n,) bytes, the n-th from byte n of `stream` on, and count results.

    out  (4,)  reads OK; STALE; samples that are not finite or whose quaternion is not of unit length; reads below 0
    """
    byte = uint8_at(stream)
    for n in range(len(sizes)):
        if n % 3 != 0:
            byte[n] = 3
        write_fd(fd, stream + n, sizes[n])
        status = call_device(read, handle, sample)
        out[status if status >= 0 else 3] += 1
        if status >= 0:
            norm = total = 0.0
            for k in range(3, 7):
                norm += sample[k] * sample[k]
            for k in range(len(sample)):
                total += sample[k]
            if not isfinite(total) or not abs(norm - 1.0) < 1e-9:  # rounding of a normalisation
                out[2] += 1


@pytest.mark.scaled
def test_reports_give_a_finite_pose_or_a_fault(cases: Callable[[int, int], int]) -> None:
    fd, end = ends()
    generator = np.random.default_rng(11)
    number = cases(20_000, 1_000_000)
    stream = generator.integers(0, 256, number + 64, dtype=np.uint8)
    sizes = np.where(np.arange(number) % 4 > 0, 31, generator.integers(1, 64, number))
    good = b"\x03" + struct.pack("<7fBB", 1, 2, 3, 1, 0, 0, 0, 0, 0)
    with Answering(end, lambda _: good), HidDevice(build(Options, described(), "rig"), fd) as device:
        assert DeviceCaller(device, arm=False).read()[0] == OK
        io, sample, out = device.io(), np.zeros(SAMPLE_SIZE), np.zeros(4, np.int64)
        fuzz(end.fileno(), io.read, io.handle, stream.ctypes.data, sizes, sample, out)
        read, repeated, wrong, refused = out.tolist()
        assert wrong == 0
        assert read + repeated + refused == number and min(read, repeated, refused) > number // 100


def test_nodes_that_cannot_be_opened(tmp_path: Path) -> None:
    node = tmp_path / "hidraw9"
    node.write_bytes(b"")
    for path, message in ((node, "is not a device node: use a /dev/hidrawN"), ("/dev/null", "is not a hidraw node: ")):
        with pytest.raises(DeviceError, match=message):
            open_device(rig_options("woodenhaptics-2019", path=str(path)), 1000.0)
    with node.open("rb") as locked_file:
        fcntl.flock(locked_file, fcntl.LOCK_EX)
        with pytest.raises(DeviceBusy, match=rf"hidraw9 is used by process {os.getpid()} \("):
            open_device(rig_options("woodenhaptics-2019", path=str(node)), 1000.0)
