"""Exchange with a HID device, call by call: reports sent, decoding of reports, counters."""

import ctypes
import struct
from typing import Any

import numpy as np
import pytest
from helpers.hid_devices import described
from helpers.plain_by_call import BY_CALL, MOUNTING, MS, START_NS, FarEnd, File, by_call, check_pose

from softfinger.config.load import build
from softfinger.drivers import board_exchange, described_board
from softfinger.drivers.base import HELD, LOST, OK, PROTOCOL, STALE, TIMEOUT
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.described_board import DESCRIBED
from softfinger.drivers.fields.table import POSITION, WRIST
from softfinger.drivers.hid import device, exchange
from softfinger.drivers.hid.device import HidDevice, Options
from softfinger.drivers.hid.exchange import AT
from softfinger.drivers.hid.link import ReportLink

pytestmark = BY_CALL

FD = 5
ZERO = (0.0,) * 6
EIO, ETIMEDOUT = 5, 110


class Board(FarEnd):
    exchange = exchange

    def __init__(self, patch: pytest.MonkeyPatch, **changes: Any) -> None:
        self.clock, self.node = (
            by_call(patch, exchange, board_exchange, described_board, device),
            File(FD, packets=True),
        )
        patch.setattr(exchange, "read_now", self._read)
        patch.setattr(exchange, "write_now", self.node.write)
        patch.setattr(board_exchange, "wait_readable", lambda *_: False)
        options = {**described(mounting=MOUNTING, kick_s=0.01, timeout_s=0.1), **changes}
        self.block = HidDevice(build(Options, options, "rig"), ReportLink(FD))._block
        self.block.fixed = [
            (DESCRIBED.values + WRIST, DESCRIBED.values + POSITION),  # no wrist is sensed
            (DESCRIBED.model, AT.reports),
        ]
        self.clock.room = {self.block.handle + 8 * BOARD.timespec}
        self.word[BOARD.has_sample], self.word[BOARD.sampled_at] = 1, START_NS
        self.word[BOARD.opened_at] = START_NS - 2000 * MS
        self.word[BOARD.read_at] = self.word[BOARD.kicked_at] = START_NS

    def _read(self, fd: int, address: int, size: int) -> int:
        buffer = next(
            b for at in (AT.in_buffer, AT.latest_report) if (b := self.block._arrays[at]).ctypes.data == address
        )
        assert size == buffer.nbytes
        return self.node.read(fd, address, size)

    def read(self, *incoming: bytes) -> tuple[int, np.ndarray]:
        self.node.incoming += incoming
        return super().read()

    def sent(self) -> list[bytes]:
        """Return the reports that the board received since the last call."""
        out = self.node.sent[:]
        self.node.sent.clear()
        return out

    def make_thread_link(self) -> ctypes.c_int64:
        self.accepted_address = ctypes.c_int64()
        self.word[AT.accepted_address] = ctypes.addressof(self.accepted_address)
        return self.accepted_address


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Board:
    return Board(monkeypatch)


def report(x: float, y: float, z: float, *rest: float, buttons: int = 0, gripper: int = 0) -> bytes:
    return b"\x03" + struct.pack("<7fBB", x, y, z, *(rest or (1.0, 0.0, 0.0, 0.0)), buttons, gripper)


def force_report(x: int, y: int, z: int) -> bytes:
    """Return an output report of a force (mN)."""
    return b"\x04" + struct.pack("<3i", x, y, z)


@pytest.mark.parametrize("length", [1.0, 2.0])
def test_a_report_is_a_pose_in_the_world(length: float, board: Board) -> None:
    q = (0.5, 0.1, -0.7, 0.5)
    status, sample = board.read(report(250.0, 500.0, -125.0, *(length * k for k in q), buttons=6, gripper=50))
    assert status == OK
    check_pose(sample, (0.25, 0.5, -0.125), q, rounding=1e-7)  # a float32 of 0.7
    assert sample[7:].tolist() == [2.0, 6.0, 0.5]
    assert board.counts() == {"reports": 1}


def test_the_last_report_of_a_tick_is_used(board: Board) -> None:
    reports = [report(n, 0.0, 0.0) for n in (1.0, 2.0, 3.0)]
    status, sample = board.read(reports[0], b"\x07not ours, and longer than ours is", reports[1], reports[2])
    assert (status, sample[1]) == (OK, pytest.approx(0.203))
    assert board.counts() == {"reports": 3, "drained": 2, "foreign": 1} and board.read()[0] == STALE
    status, sample = board.read(report(4.0, 0.0, 0.0), b"\x07 one behind it")
    assert (status, sample[1]) == (OK, pytest.approx(0.204))
    assert board.counts() == {"reports": 4, "drained": 2, "foreign": 2}


def test_a_flood_does_not_delay_the_loop(board: Board) -> None:
    """A tick reads at most 256 reports, four times the kernel's queue of a node."""
    assert board.read(*[report(1.0, 0.0, 0.0)] * 600)[0] == OK
    assert board.counts() == {"reports": 256, "drained": 255}


@pytest.mark.parametrize("spoilt", [lambda r: r[:-1], lambda r: r + b"\0", lambda r: r[:1]])
def test_a_report_of_another_length_is_a_fault(spoilt: Any, board: Board) -> None:
    assert board.read(spoilt(report(1.0, 0.0, 0.0)))[0] == PROTOCOL and board.counts() == {}


def test_a_node_that_fails_or_ends_is_lost(board: Board) -> None:
    board.node.incoming = [b""]
    assert board.read()[0] == LOST
    board.node.error = EIO
    assert board.read()[0] == LOST


@pytest.mark.parametrize(
    "numbers", [(np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0), (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0), (0, 0, 0, np.nan, 0, 0, 0)]
)
def test_a_report_that_is_no_pose_is_a_fault(numbers: tuple[float, ...], board: Board) -> None:
    _, before = board.read(report(1.0, 0.0, 0.0))
    assert board.read(report(*numbers))[0] == PROTOCOL
    assert board.read()[1].tolist() == before.tolist() and "singular" not in board.counts()


def test_reports_without_an_id_start_with_their_data(monkeypatch: pytest.MonkeyPatch) -> None:
    reports = described()["reports"]
    fields = [{"meaning": m, "offset": 4 * n, "type": "float32"} for n, m in enumerate("xyz")]
    out = {**reports["output"], "id": 0}
    board = Board(monkeypatch, reports={"input": {"bytes": 12, "field": fields}, "output": out})
    status, sample = board.read(struct.pack("<3f", 0.25, 0.0, 0.0))
    assert (status, sample[1]) == (OK, pytest.approx(0.45)) and sample[3:7].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert board.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
    assert board.sent() == [b"\0" + struct.pack("<3i", 0, 0, 1000)]


def test_a_force_reaches_the_device_in_its_own_frame(board: Board) -> None:
    for force, status in (((0.5, -1.0, 2.0), OK), ((0.0, 30.0, -40.0), STALE), ((0.0, 0.0, 0.0), OK)):
        assert board.write(*force, 3.0, 3.0, 3.0) == status and board.word[BOARD.has_force] == any(force)
    assert board.sent() == [force_report(-1000, -500, 2000), force_report(2400, 0, -3200), force_report(0, 0, 0)]
    assert board.counts() == {"written": 3, "cut": 1} and board.write(*ZERO) == OK
    assert board.sent() == [force_report(0, 0, 0)]  # each report triggers an answer, which the loop needs


def test_results_of_writing_a_report(board: Board) -> None:
    """A full node gives HELD, because the device keeps the previous force; a partial write or an error ends the run."""
    for room, error, status in (
        (0, 0, HELD), (-1, 0, PROTOCOL), (1, 0, PROTOCOL), (12, 0, PROTOCOL),
        (None, ETIMEDOUT, TIMEOUT), (None, EIO, LOST), (None, 11, HELD),
    ):  # fmt: skip
        board.node.room, board.node.error = room, error
        assert board.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == status and board.word[BOARD.has_force] == 0
        board.word[BOARD.has_force], board.node.room = 1, room
        assert board.write(*ZERO) == status
        assert board.word[BOARD.has_force] == 1  # the zero was not sent
        board.word[BOARD.has_force] = 0
    assert "written" not in board.counts()
    board.node.room = board.node.error = 0
    assert board.write(0.0, 0.0, 30.0, 0.0, 0.0, 0.0) == HELD and board.counts() == {"cut": 1}


def test_a_force_waits_for_the_thread_that_writes_reports(board: Board) -> None:
    value = board.make_thread_link()
    for force, status in ((1.0, OK), (2.0, OK), (3.0, HELD), (0.0, OK), (0.0, OK)):
        assert board.write(0.0, 0.0, force, 0.0, 0.0, 0.0) == status
    assert board.block.call(lambda handle: exchange._wake(exchange.Hid(), handle)) == OK
    assert board.block.call(exchange.disarm_and_zero) == 1
    assert board.sent() == [force_report(0, 0, 1000), force_report(0, 0, 2000), force_report(0, 0, 0)]
    assert board.counts() == {"written": 3, "held": 1, "kicks": 1}
    value.value = 2
    board.word[BOARD.armed] = 1
    assert board.write(0.0, 0.0, 3.0, 0.0, 0.0, 0.0) == OK and board.write(0.0, 0.0, 3.0, 0.0, 0.0, 0.0) == HELD
    value.value = 3
    assert board.write(*ZERO) == OK and board.sent() == [force_report(0, 0, 3000), force_report(0, 0, 0)]
