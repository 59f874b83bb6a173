"""Forces queued in a serial port: frames that a simulated board receives, by board, port, line fault and exit.

The simulated port follows tty_ioctl(4) and the Linux drivers: a UART counts bytes, a USB modem one buffer per write,
and the driver of a USB chip ignores a flush. The simulated boards have independent frame parsers. The test with a real
daemon and a real clock is in `test_serial_boards`.
"""

import ctypes
import struct
from collections.abc import Callable
from errno import EAGAIN, EIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from emulators.guideboard import crc8
from helpers.described_boards import rig_options
from helpers.plain_by_call import BY_CALL, MS, by_call
from test_serial_exchange import Board, frame

from softfinger.drivers import block, board_exchange
from softfinger.drivers.base import HELD, OK, SAMPLE_SIZE, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.serial import device, exchange, queue
from softfinger.drivers.serial.block import AT
from softfinger.drivers.serial.device import BLOCKED, SerialDevice
from softfinger.proxy.kernels.jit.compiler.numba_internals import CFunction

pytestmark = BY_CALL

PUSH = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
ZERO = (0.0,) * 6
WRITE_BYTES = 1280
"""Buffer size of cdc-acm at full speed."""
KINDS = ("uart", "modem", "chip")


class Port:
    def __init__(self, kind: str, per_ms: float, board: Any) -> None:
        self.kind, self.per_ms, self.board = kind, per_ms, board
        self.waiting: list[tuple[int, int, int]] = []
        """Queued bytes: time of the write (ns), number of the write, value."""
        self.incoming, self.error, self.stalled, self.writes = b"", 0, False, 0
        self._credit = 0.0

    def advance(self, now: int) -> None:
        self._credit += self.per_ms
        while self.waiting and self._credit >= 1.0 and not self.stalled:
            written, _, byte = self.waiting.pop(0)
            self._credit -= 1.0
            self.incoming += self.board.take(byte, (now - written) / MS)
        self._credit = min(self._credit, self.per_ms)
        self.incoming += self.board.streams()

    def read_waiting(self, fd: int, address: int, size: int, word: int) -> int:
        if self.error:
            return -self.error
        data, self.incoming = self.incoming[:size], self.incoming[size:]
        ctypes.memmove(address, data, len(data))
        return len(data)

    def write(self, fd: int, address: int, size: int) -> int:
        if self.error:
            return -self.error
        if len(self.waiting) + size > 4096:
            return -EAGAIN
        self.writes += 1
        data = ctypes.string_at(int(address), size)
        self.waiting += [(self.now(), self.writes, byte) for byte in data]
        return size

    now: Callable[[], int]

    def unsent(self) -> int:
        if self.error:
            return -self.error
        if self.kind == "modem":
            return WRITE_BYTES * len({number for _, number, _ in self.waiting})
        return len(self.waiting)

    def flush(self) -> None:
        if self.kind != "chip":
            self.waiting.clear()


class Reader:
    """Frame parser of a board. `given` has one entry per frame: if it has a force, and its age at arrival (ms)."""

    def __init__(self) -> None:
        self.received: list[tuple[bool, float]] = []
        self.rest = b""

    def take(self, byte: int, age_ms: float) -> bytes:
        self.rest += bytes([byte])
        return self.parse(age_ms)

    def parse(self, age_ms: float) -> bytes:
        raise NotImplementedError

    def streams(self) -> bytes:
        return b""

    @property
    def pushes(self) -> bool:
        return bool(self.received) and self.received[-1][0]


class Hapkit(Reader):
    bytes = 4

    def parse(self, age_ms: float) -> bytes:
        if len(self.rest) >= 4:
            if self.rest[0] == 0x5A and crc8(self.rest[:3]) == self.rest[3]:
                self.received.append((self.rest[1:3] != b"\0\0", age_ms))
                self.rest = b""
            else:
                self.rest = self.rest[1:]
        return b""

    def streams(self) -> bytes:
        head = b"\xa5" + struct.pack("<i", 40)
        return head + bytes([crc8(head)])


class Haply2diy(Reader):
    bytes = 10

    def parse(self, age_ms: float) -> bytes:
        if self.rest[0] != 2:
            self.rest = b""
        elif len(self.rest) >= 10:
            # resync bytes complete a truncated frame with 1e-36 N m
            self.received.append((max(map(abs, struct.unpack("<2f", self.rest[2:]))) > 1e-9, age_ms))
            self.rest = b""
            return b"\5" + struct.pack("<2f", 30.0, 150.0)
        return b""


class Woody(Reader):
    bytes = 64

    def parse(self, age_ms: float) -> bytes:
        if not self.rest.endswith(b"\n"):
            return b""
        line, self.rest = self.rest, b""
        if len(line) == 64:
            self.received.append((line.split()[:3] != [b"0"] * 3, age_ms))
        return frame(1.0, 2.0, 3.0)


BOARDS: dict[str, type[Any]] = {"hapkit": Hapkit, "haply-2diy": Haply2diy, "woodenhaptics-v3": Woody}


class Run:
    def __init__(self, rig: str, kind: str, per_ms: float, patch: pytest.MonkeyPatch, **options: Any) -> None:
        self.reader = BOARDS[rig]()
        self.driver = Board(rig_options(rig, **{"timeout_s": 0.2, "quiet_s": 0.02, **options}), patch)
        self.clock, self.word = self.driver.clock, self.driver.word
        self.port = Port(kind, per_ms, self.reader)
        self.port.now = lambda: self.clock.now
        self.driver.port = self.port
        by_call(patch, queue)
        patch.setattr(queue, "read_monotonic_ns", self.clock)
        patch.setattr(exchange, "write_now", self.port.write)
        patch.setattr(queue, "count_unsent", self._count_unsent)
        patch.setattr(queue, "drop_unsent", lambda fd: self.port.flush())
        patch.setattr(board_exchange, "wait_readable", lambda *_: self.sleep(0.001))
        patch.setattr(device, "count_unsent", self._unsent)
        time = SimpleNamespace(
            monotonic=lambda: self.clock.now * 1e-9, monotonic_ns=lambda: self.clock.now, sleep=self.sleep
        )
        for module in (device, block):
            patch.setattr(module, "time", time)
        patch.setattr(CFunction, "ctypes", property(lambda function: lambda handle: int(function(handle))))
        self.device = SerialDevice.__new__(SerialDevice)
        self.device._block, self.device._zero_failure = self.driver.block, ""
        self.device.info = SimpleNamespace(name="serial")
        self.word[AT.counts_unsent] = 1
        self.statuses: list[int] = []

    def _count_unsent(self, fd: int, word: int) -> int:
        assert word == self.driver.block.handle + 8 * AT.ioctl_scratch
        return self.port.unsent()

    def _unsent(self, fd: int) -> int:
        if self.port.error:
            raise OSError(self.port.error, "Input/output error")
        return self.port.unsent()

    def sleep(self, _: float) -> None:
        self.clock.now += MS
        self.port.advance(self.clock.now)

    def ticks(self, count: int, wrench: tuple[float, ...] = PUSH) -> None:
        for _ in range(count):
            self.sleep(0.001)
            status = self.driver.block.call(exchange.read, np.zeros(SAMPLE_SIZE))
            if status >= 0:
                status = self.driver.write(*wrench)
            self.statuses.append(status)
            if status < 0:
                return

    def end(self) -> None:
        self.driver.write(*ZERO)
        self.device.stop()

    def goes_on(self) -> None:
        self.port.stalled = False
        for _ in range(20 + int(len(self.port.waiting) / self.port.per_ms)):
            self.sleep(0.001)


def old_forces(run: Run) -> int:
    longest = 3 * run.reader.bytes / run.port.per_ms + 2.0
    return sum(pushes and age > longest for pushes, age in run.reader.received)


def push(run: Run, line: str) -> None:
    """Write forces to a line that is sound, slow, dead, or dead for 100 ms."""
    if line == "slow":
        run.port.per_ms = 0.2 * run.reader.bytes
    run.port.stalled = line in ("dead", "dead for a time")
    run.ticks(20 if line == "sound" else 100)
    if line == "dead for a time":
        run.port.stalled = False
        run.ticks(100)


@pytest.mark.parametrize("end", ["stopped", "disarmed"])
@pytest.mark.parametrize("line", ["sound", "slow", "dead", "dead for a time"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rig", BOARDS)
def test_no_old_force_is_played_and_the_last_is_zero(rig, kind, line, end, monkeypatch):
    run = Run(rig, kind, 1.5 * BOARDS[rig].bytes, monkeypatch)
    run.ticks(20)
    assert run.reader.pushes
    push(run, line)
    before = len(run.reader.received)
    if end == "stopped":
        run.end()
    else:
        run.ticks(30, ZERO)
    failure = run.device.zero_failure()
    was_stalled = run.port.stalled
    run.goes_on()
    buffered = 3 if kind == "chip" else 0
    assert old_forces(run) <= buffered
    assert sum(pushes for pushes, _ in run.reader.received[before:]) <= buffered + 1  # one force was being transmitted
    assert not run.reader.pushes
    # confirmed only if the line transmits the zero
    assert bool(failure) == (was_stalled and end == "stopped")


def test_a_stop_reports_why_its_zero_is_not_confirmed(monkeypatch, caplog):
    run = Run("hapkit", "uart", 10.0, monkeypatch)
    run.ticks(20)
    run.port.stalled = True
    begun = run.clock.now
    run.end()
    assert run.device.zero_failure() == "8 bytes have been pending for 1 s"
    assert 1000 * MS < run.clock.now - begun < 1100 * MS
    started = run.clock.now
    run.device.stop()
    assert run.clock.now - started < 200 * MS
    assert caplog.text.count("zero force has not reached it: 8 bytes have been pending") == 1
    run.port.stalled = False
    run.device.stop()
    assert run.device.zero_failure() == ""
    monkeypatch.setattr(exchange, "write_now", lambda *_: -EAGAIN)
    started = run.clock.now
    run.device.stop()
    assert run.device.zero_failure() == "the port has accepted no data for 1 s"
    assert 1000 * MS < run.clock.now - started < 1010 * MS
    refusals = iter([-EAGAIN] * 3)
    monkeypatch.setattr(exchange, "write_now", lambda *call: next(refusals, None) or run.port.write(*call))
    run.device.stop()
    assert run.device.zero_failure() == "" and next(refusals, None) is None
    run.port.error = EIO
    monkeypatch.setattr(exchange, "write_now", run.port.write)
    run.device.stop()
    assert run.device.zero_failure() == "the port was removed: Input/output error"


@pytest.mark.parametrize("kind", KINDS)
def test_a_queue_of_more_than_two_frames_withholds_the_force(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run("hapkit", kind, 10.0, monkeypatch)
    run.ticks(20)
    assert set(run.statuses) == {OK} and run.device.warning() == ""
    run.port.stalled = True
    run.ticks(2)
    assert run.statuses[20:] == [OK] * 2
    waiting = len(run.port.waiting)  # including the frame of the tick before the stall
    assert waiting == 3 * 4
    run.ticks(50)
    assert run.statuses[22:] == [WITHHELD] * 50
    assert len(run.port.waiting) == 2 * 4 + (waiting if kind == "chip" else 0)
    assert run.device.warning() == BLOCKED and run.driver.counts()["blocked"] == 1
    run.port.stalled = False
    run.ticks(20)
    assert set(run.statuses[-10:]) == {OK}
    run.clock.now += 1001 * MS
    assert run.device.warning() == ""
    run.port.stalled = True
    run.ticks(400)
    assert run.statuses[-1] == TIMEOUT and run.statuses[-2] == WITHHELD


@pytest.mark.parametrize("wrench", [PUSH, ZERO], ids=["in contact", "out of contact"])
@pytest.mark.parametrize(("timeout_s", "blocked_s"), [(0.1, 0.1), (2.0, 0.25)])
def test_a_board_that_stops_reading_counts_as_lost_in_time(timeout_s, blocked_s, wrench, monkeypatch):
    """It retains its force while it reads nothing, so the run ends after 0.25 s or a shorter `timeout_s`."""
    run = Run("hapkit", "uart", 10.0, monkeypatch, timeout_s=timeout_s)
    run.ticks(20)
    assert run.reader.pushes
    run.port.stalled = True
    run.ticks(5)
    run.ticks(3000, wrench)
    assert run.statuses[-1] == TIMEOUT and 1e3 * blocked_s < len(run.statuses) - 20 < 1e3 * blocked_s + 10
    assert run.reader.pushes, "the board keeps its force"
    assert run.device.reason() == BLOCKED


def test_a_zero_behind_a_cut_frame_is_sent_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The board appends the first zero to the cut line and rejects the result, so a second zero has to follow."""
    run = Run("woodenhaptics-v3", "uart", 20.0, monkeypatch)
    run.ticks(10)
    while not 0 < len(run.port.waiting) < 64:  # in the middle of a frame
        run.ticks(1)
    assert run.driver.block.call(exchange.discard) == 1
    assert run.driver.block.call(exchange.disarm_and_zero) == 1 and len(run.port.waiting) == 128
    run.goes_on()
    assert not run.reader.pushes and run.reader.rest == b""
    assert run.driver.block.call(exchange.disarm_and_zero) == 1 and len(run.port.waiting) == 64


def test_discard_does_not_interrupt_a_write(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run("hapkit", "uart", 10.0, monkeypatch)
    run.ticks(20)
    run.word[BOARD.lock] = 1
    assert run.driver.block.call(exchange.discard) == 0 and run.word[BOARD.armed] == 0
    run.word[BOARD.lock] = 0
    assert run.driver.block.call(exchange.discard) == 1 and run.driver.write(*PUSH) in (WITHHELD, HELD, STALE)
    assert np.array(run.word)[AT.maybe_torn] == 0  # the write has sent zeros
