"""HID devices on a packet socket: pauses, faults, calibration, random reports, opening; through threads: order of
reports, held-back forces, a hanging device, zero force at every shutdown. The contract: test_contract_at_far_ends."""

import contextlib
import fcntl
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulators.woodenhaptics import Arm, Woody
from helpers.hid_devices import RIGS, Answering, Api, described, ends, rig_options, woody
from helpers.shortages import refuse_threads
from helpers.waits import WAIT_S, repeated, until

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceTimeout
from softfinger.config.load import build
from softfinger.drivers.base import HELD, IGNORED_WRENCH_MAX_S, LOST, OK, SAMPLE_SIZE, TIMEOUT, WITHHELD
from softfinger.drivers.hid import exchange
from softfinger.drivers.hid.device import HidDevice, Options, open_device
from softfinger.drivers.hid.link import ReportLink, find_output_endpoint, make_thread_link
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
        HidDevice(rig_options("woodenhaptics-2015", timeout_s=0.5), ReportLink(fd)) as device,
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


def test_opening_ends_the_force_of_a_killed_program(monkeypatch: pytest.MonkeyPatch) -> None:
    fd, end = ends()
    monkeypatch.setattr("softfinger.drivers.hid.device.open_link", lambda _: ReportLink(fd))
    with end, open_device(rig_options("woodenhaptics-2019", calibrate=False), 1000.0):
        assert end.recv(100, socket.MSG_DONTWAIT) == bytes(65)


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
        assert device.zero_command() is None
        device._link = device._link._replace(node="/dev/hidraw7")
        servo = DeviceCaller(device)
        servo.read()
        servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        answering.settle(device)
        assert any(arm.sent[-1])
        node, fd, zero, *_ = device.zero_command()
        assert node == "/dev/hidraw7" and os.fstat(fd)
        arm.answer(zero)
        assert not any(arm.sent[-1])


def test_the_last_report_of_threads_goes_to_the_node() -> None:
    """The threads' socket has no reader after a kill."""
    options, (fd, end) = rig_options("woodenhaptics-2019"), ends()
    node = os.open("/dev/null", os.O_RDWR)
    link = make_thread_link(Api(fd), options, node)._replace(node="/dev/hidraw7")
    with end, HidDevice(options, link) as device:
        assert device.zero_command().fd == node


def test_the_last_report_on_the_bus_goes_to_the_endpoint() -> None:
    """USB 2.0, 9.6: the endpoints of an interface follow it; HID 1.11, 4.4: a device may have none for output."""
    interfaces = [bytes([9, 4, n, 0, 2, 3, 0, 0, 0, 9, 0x21, 0x11, 1, 0, 1, 0x22, 63, 0]) for n in range(3)]
    ends_0, ends_1 = (bytes([7, 5, 0x81 + n, 3, 64, 0, 1, 7, 5, 0x02 + n, 3, 64, 0, 1]) for n in (0, 2))
    blob = bytes([18, 1, *range(16), 9, 2, *range(7)]) + interfaces[0] + ends_0 + interfaces[1] + ends_1 + interfaces[2]
    assert [find_output_endpoint(blob, n) for n in range(4)] == [0x02, 0x04, 0, 0]
    assert find_output_endpoint(blob[:-40], 2) == find_output_endpoint(b"\0" * 40, 0) == 0
    options, (fd, end) = rig_options("woodenhaptics-2019"), ends()
    link = make_thread_link(Api(fd), options)._replace(node="/dev/bus/usb/001/002", interface=1, endpoint=4)
    with end, HidDevice(options, link) as device:
        node, no_fd, zero, *to = device.zero_command()
    # The bus needs no report id if a device has a single report.
    assert (node, no_fd, to, len(zero), any(zero)) == ("/dev/bus/usb/001/002", None, [1, 4], 64, False)


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
    with Answering(end, answer), HidDevice(options, ReportLink(fd)) as device:
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
    with Answering(end, lambda _: good), HidDevice(build(Options, described(), "rig"), ReportLink(fd)) as device:
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


GOOD = b"\x03" + struct.pack("<7fBB", 1, 2, 3, 1, 0, 0, 0, 0, 0)
"""A report of the described device."""


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    remaining = [thread for thread in set(threading.enumerate()) - before if thread.name.startswith("hid ")]
    for thread in remaining:  # a hung thread ends once its write returns
        thread.join(WAIT_S)
    assert not any(thread.is_alive() for thread in remaining)


class ThreadedBoard(AbstractContextManager[Any]):
    def __init__(self, **changes: object) -> None:
        self.received: list[bytes] = []

        def note(data: bytes) -> bytes:
            self.received.append(data)
            return GOOD

        options = build(Options, described(**{"timeout_s": 0.2, **changes}), "rig")  # a busy machine answers late
        fd, end = ends()
        self.answering, self.api = Answering(end, note), Api(fd)
        link = make_thread_link(self.api, options)
        self.device = HidDevice(options, link)
        self.servo = DeviceCaller(self.device)

    def force(self, index: int = -1) -> tuple[int, ...]:
        """Return the force (mN) of a report sent to the device."""
        return struct.unpack("<3i", self.received[index][1:])

    def push(self, newtons: float) -> int:
        return self.servo.write(newtons, 0.0, 0.0, 0.0, 0.0, 0.0)

    def until(self, wanted: Callable[[int], bool]) -> int:
        statuses: list[int] = []
        until(lambda: statuses.append(self.servo.read()[0]) or wanted(statuses[-1]))
        return statuses[-1]

    def hang(self) -> None:
        """Apply 1 N, then let the write of 2 N hang."""
        self.until(lambda status: status == OK)
        self.push(1.0)
        self.answering.settle(self.device)
        self.api.ready.clear()
        self.push(2.0)
        assert self.api.hung.wait(WAIT_S)

    def __exit__(self, *_: object) -> None:
        self.api.ready.set()
        self.device.close()
        self.answering.unplug()


def test_reports_are_transferred_byte_for_byte() -> None:
    fd, end = ends()
    options = build(Options, described(), "rig")
    link = make_thread_link(Api(fd), options)
    assert link.threads is not None
    generator = np.random.default_rng(5)
    longest = options.reports.input.bytes + 1 + exchange.IN_SPARE
    for _ in range(2000):
        sent = generator.bytes(int(generator.integers(1, 64)))
        end.send(sent)
        assert select.select([link.fd], [], [], WAIT_S)[0] and os.read(link.fd, 4096) == sent[:longest]
    os.close(link.fd)
    link.threads.close()
    end.close()


def test_one_force_is_queued_behind_another() -> None:
    with ThreadedBoard() as linked:
        linked.until(lambda status: status == OK)
        linked.answering.settle(linked.device)
        linked.api.ready.clear()
        statuses = [linked.push(0.1 * (n + 1)) for n in range(21)]
        assert statuses == [OK] * exchange.QUEUED_MAX + [HELD] * (21 - exchange.QUEUED_MAX)
        assert linked.device.counts()["held"] == 21 - exchange.QUEUED_MAX
        assert [linked.push(0.0) for _ in range(5)] == [OK] * 5 and linked.push(0.1) == HELD
        known = len(linked.received)
        linked.api.ready.set()
        linked.answering.settle(linked.device)
        assert [linked.force(n)[0] for n in range(known, len(linked.received))] == [100, 200, 0]


def test_a_write_that_hangs_ends_the_run_within_any_timeout_s() -> None:
    """During a hanging write the device retains its force, so the loop ends with TIMEOUT before `timeout_s`."""
    with ThreadedBoard(timeout_s=2.0) as linked:
        linked.hang()
        begun = time.monotonic()
        while (status := linked.servo.read()[0]) >= 0:
            linked.answering.end.send(GOOD)
            assert linked.push(0.0) >= 0
            time.sleep(0.001)
        assert status == TIMEOUT
        assert IGNORED_WRENCH_MAX_S - 0.1 < time.monotonic() - begun < 2.0  # 0.25 s on a machine without stalls
        assert linked.force()[0] == 1000 and "a write has not returned for" in linked.device.reason()


@pytest.mark.parametrize("talkative", [False, True])
def test_a_write_that_hangs_is_a_time_out(talkative: bool, caplog: pytest.LogCaptureFixture) -> None:
    with ThreadedBoard() as linked:
        linked.hang()
        with repeated(lambda: linked.answering.end.send(GOOD), 0.001) if talkative else nullcontext():
            while (status := linked.servo.read()[0]) >= 0:
                linked.push(3.0)
                time.sleep(0.001)
            assert status == TIMEOUT
            assert "a write has not returned for" in linked.device.reason()
        linked.device.stop()
        linked.device.stop()
        linked.device.close()  # while the write still hangs
        assert caplog.text.count("zero force has not reached it: a write has not returned for") == 1
        assert "a write has not returned for" in linked.device.zero_failure()
        assert "hid writer: a call of hidapi does not return" in caplog.text
        assert linked.api.closed == 0, "closed under a call"
        known = len(linked.received)
        linked.api.ready.set()
        until(lambda: linked.api.closed)
        linked.answering.unplug()
        assert [linked.force(n)[0] for n in range(known, len(linked.received))] == [2000, 0, 0]


def test_old_reports_fit_into_one_tick() -> None:
    """Fewer reports are queued during a pause than one tick reads, so the report after it is current."""
    with ThreadedBoard() as linked:
        linked.until(lambda status: status == OK)
        for n in range(400):
            linked.answering.end.send(b"\x03" + struct.pack("<7fBB", n, 0, 0, 1, 0, 0, 0, 0, 0))
        time.sleep(0.05)  # a pause after which queued reports are discarded
        drained = linked.device.counts()["reports"]
        status, sample = linked.servo.read()
        assert status == OK
        assert sample[0] == pytest.approx(1e-3, abs=1e-9)  # float32 of the answer's millimetre
        assert linked.device.counts()["reports"] - drained < exchange.DRAIN_MAX


def test_stop_returns_after_the_zero() -> None:
    for _ in range(10):
        with ThreadedBoard() as linked:
            written: list[bytes] = []
            linked.until(lambda status: status == OK)
            plain = linked.api.write

            def slow(buff: bytes, plain: Callable[[bytes], int] = plain, written: list[bytes] = written) -> int:
                time.sleep(0.003)
                written.append(buff)
                return plain(buff)

            linked.api.write = slow
            for _ in range(20):
                linked.servo.read()
                linked.push(1.0)
                time.sleep(0.0005)
            linked.device.stop()
            assert linked.device.zero_failure() == ""
            assert any(written[0][1:]) and not any(written[-1][1:])
            count = len(written)
            assert linked.push(1.0) == WITHHELD
            linked.answering.settle(linked.device)
            assert not any(any(report[1:]) for report in written[count:])


@pytest.mark.parametrize("rig", ["woodenhaptics-2015", "woodenhaptics-polhem-v1"])
def test_calibration_at_opening(rig: str) -> None:
    options = rig_options(rig, calibrate=True, timeout_s=1.0)
    itself = Arm(RIGS[rig])
    resting = itself.position(itself.angles_at(itself.calibration))
    arm = Woody(RIGS[rig], 1 if options.reports.preset is None else 2, lambda _: resting)
    arm.zero = (321, -123, 77)

    def answer(data: bytes) -> bytes:
        time.sleep(0.004)  # of the 10 ms between two kicks
        return arm.answer(data)

    fd, end = ends()
    with Answering(end, answer):
        link = make_thread_link(Api(fd), options)
        with HidDevice(options, link) as device:
            sample = DeviceCaller(device).read()[1]
            np.testing.assert_allclose(sample[:3], resting, atol=3e-4)  # half a count at each motor
            assert all(not any(words[:3]) for words in arm.sent), "a force during calibration"
            assert sum(words[3] for words in arm.sent) == (options.reports.preset is not None)
            assert (arm.zero == (0, 0, 0)) == (options.reports.preset is not None)  # the device has stored the counts


def test_a_failed_calibration_closes_the_device() -> None:
    options = rig_options("woodenhaptics-2019", calibrate=True, timeout_s=1.0)  # a busy machine answers late
    for answer, error, message in (
        (None, DeviceTimeout, "sends no report"),
        (b"\0" * 64, DeviceError, r"did not apply the calibration: .* are \[0.0, 0.0, 0.0\] and not \[.*6000"),
    ):
        fd, end = ends()
        with Answering(end, lambda _, answer=answer: answer):
            api = Api(fd)
            link = make_thread_link(api, options)
            with pytest.raises(error, match=message):
                HidDevice(options, link)
            assert api.closed == 1


@pytest.mark.parametrize("refused", ["hid reader", "hid writer"])
def test_a_device_without_a_thread_is_closed(refused: str, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_threads(monkeypatch, refused)
    before = len(os.listdir("/proc/self/fd"))
    fd, end = ends()
    api = Api(fd)
    with end, pytest.raises(RuntimeError):
        make_thread_link(api, rig_options("woodenhaptics-2019"), os.open(os.devnull, os.O_RDONLY))
    until(lambda: len(os.listdir("/proc/self/fd")) == before)
    assert api.closed == 1


@pytest.mark.parametrize("cause", ["unplugged", "read", "write"])
def test_a_disconnected_device_is_lost(cause: str) -> None:
    with ThreadedBoard() as linked:
        linked.until(lambda status: status == OK)
        linked.push(1.0)
        linked.answering.settle(linked.device)
        if cause == "unplugged":
            linked.answering.unplug()
        elif cause == "read":
            linked.api.read = raise_read_error
        else:
            linked.api.refuses = True
            linked.push(1.0)
        assert linked.until(lambda status: status < 0) == LOST
        linked.device.stop()
        reasons = {"read": "hid reader: read error", "write": "hid writer: a write of 13 bytes returned -1"}
        assert reasons.get(cause, "hid ") in linked.device.reason()
        if cause == "read":
            assert linked.force() == (0, 0, 0)
        else:
            assert linked.servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) in (LOST, WITHHELD)
        linked.device.close()
        assert linked.api.closed == 1


def raise_read_error(*_: object) -> list[int]:
    raise OSError("read error")


def test_the_device_names_its_threads() -> None:
    with ThreadedBoard() as linked:
        threads = {thread.native_id for thread in threading.enumerate() if thread.name in ("hid reader", "hid writer")}
        assert set(linked.device.thread_ids()) == threads and len(threads) == 2
