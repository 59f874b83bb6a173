"""Exchange with a serial board, call by call: bytes sent, decoding of frames, counters."""

import struct
from binascii import crc_hqx
from typing import Any

import numpy as np
import pytest
from emulators.guideboard import crc8
from helpers.plain_by_call import ABOUT_Z, BY_CALL, MOUNTING, MS, START_NS, FarEnd, File, by_call, matrix, turned
from helpers.serial_devices import rig_options

from softfinger.config.load import build
from softfinger.drivers import board_exchange, described_board
from softfinger.drivers.base import HELD, LOST, OK, STALE, WITHHELD
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.described_board import DESCRIBED
from softfinger.drivers.serial import device, exchange
from softfinger.drivers.serial.device import Options, SerialDevice
from softfinger.drivers.serial.exchange import AT

pytestmark = BY_CALL

FD = 5
TEXT = {"force_max_n": 5.0, "quiet_s": 0.02, "timeout_s": 0.2, "kick_s": 0.1}
ZERO = (0.0,) * 6


def frame(x: float, y: float, z: float, *rest: float) -> bytes:
    a, b, d, e, info = rest or (0.0, 0.0, 0.0, 0.0, 0)
    return f"{x:.3f} {y:.3f} {z:.3f} {a:.4f} {b:.4f} {d:.4f} {e:.4f} {info}".ljust(63).encode() + b"\n"


def text(*milli: int) -> bytes:
    return " ".join(map(str, [*milli, 2, 0, 0, 0])).ljust(63).encode() + b"\n"


class Board(FarEnd):
    exchange = exchange

    def __init__(self, options: Options, patch: pytest.MonkeyPatch) -> None:
        self.clock, self.port = by_call(patch, exchange, board_exchange, described_board, device), File(FD)
        patch.setattr(exchange, "read_waiting", self._read)
        patch.setattr(exchange, "write_now", self.port.write)
        patch.setattr(board_exchange, "wait_readable", lambda *_: False)
        opened = SerialDevice.__new__(SerialDevice)  # without the board's answer to its opening
        opened._options = options
        self.block = opened._make_block(FD)
        self.block.fixed = [(DESCRIBED.model, AT.bytes)]
        if options.kinematics is not None:  # no text is received
            self.block.fixed.append((AT.incoming, len(self.word)))
        self.clock.room = {self.block.handle + 8 * BOARD.timespec}
        self.word[BOARD.has_sample], self.word[BOARD.sampled_at] = 1, START_NS
        self.word[BOARD.opened_at] = START_NS - 2000 * MS
        self.word[BOARD.read_at] = self.word[BOARD.kicked_at] = START_NS

    def _read(self, fd: int, address: int, size: int, word: int) -> int:
        assert word == self.block.handle + 8 * AT.ioctl_scratch
        if self.word[DESCRIBED.kind] == exchange.TEXT:
            assert address + size <= self.block.handle + self.word.nbytes
        else:
            assert address + size <= self.word[AT.stream] + self.block._arrays[AT.stream].nbytes
        return self.port.read_waiting(fd, address, size, word)

    def read(self, *incoming: bytes) -> tuple[int, np.ndarray]:
        self.port.incoming += incoming
        return super().read()

    def wake(self) -> int:
        return self.block.call(lambda handle: exchange._wake(exchange.Serial(), handle))

    def sent(self) -> bytes:
        """Return the bytes that the board received since the last call."""
        out = b"".join(self.port.sent)
        self.port.sent.clear()
        return out


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Board:
    return Board(rig_options(**TEXT, mounting=MOUNTING), monkeypatch)


# --- WoodenHaptics' text ---


def test_a_text_frame_is_a_pose_in_the_world(board: Board) -> None:
    a, b, d, e = 0.3, 0.5, 0.7, -1.1
    status, sample = board.read(frame(10.0, 20.0, -15.0, a, b, d, e, -2))
    assert status == OK
    np.testing.assert_allclose(sample[:3], ABOUT_Z @ (0.01, 0.02, -0.015) + (0.1, 0.2, 0.3), atol=1e-12)
    wanted = ABOUT_Z @ turned(2, a) @ turned(1, -b) @ turned(0, d) @ turned(1, e)
    np.testing.assert_allclose(matrix(sample[3:7]), wanted, atol=1e-12)
    assert sample[7:].tolist() == [2.0, 65534.0, 0.0]
    assert board.counts() == {"bytes": 64, "frames": 1}


def test_the_last_frame_of_a_tick_is_used(board: Board) -> None:
    status, sample = board.read(frame(1.0, 0.0, 0.0) + frame(2.0, 0.0, 0.0) + frame(3.0, 0.0, 0.0))
    assert (status, sample[1]) == (OK, pytest.approx(0.203))
    assert board.counts() == {"bytes": 192, "frames": 3, "drained": 2}
    whole = frame(4.0, 0.0, 0.0)
    for data, status, misread in ((b"Marlin\n", STALE, 7), (whole[:40], STALE, 47), (whole[40:], OK, 0)):
        assert board.read(data)[0] == status and board.word[BOARD.misread_bytes] == misread
    assert board.counts() == {"bytes": 192 + 7 + 64, "frames": 4, "drained": 2}


def test_a_flood_does_not_delay_the_loop(board: Board) -> None:
    """A tick reads at most 16 kB, four times the kernel's queue of a port; the rest is read in the next tick."""
    assert board.read(b" " * 40_000)[0] == STALE and board.counts() == {"bytes": 16 * 1024}
    assert board.port.reads == 16
    board.read()
    board.read()
    assert board.counts() == {"bytes": 40_000}


def test_a_port_that_fails_is_lost(board: Board) -> None:
    board.port.error = 5
    assert board.read()[0] == LOST and board.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == LOST
    assert board.wake() == LOST
    board.word[BOARD.unsent_bytes] = 10
    assert board.write(*ZERO) == LOST and board.wake() == LOST


def test_a_force_reaches_the_board_in_its_own_frame(board: Board) -> None:
    board.read(frame(0.0, 0.0, 0.0))
    assert board.write(0.5, -1.0, 2.0, 3.0, 3.0, 3.0) == OK and board.sent() == text(-1000, -500, 2000)
    board.read(frame(0.0, 0.0, 0.0))
    assert board.write(0.0, 30.0, -40.0, 0.0, 0.0, 0.0) == STALE and board.sent() == text(3000, 0, -4000)
    assert board.counts() == {"bytes": 128, "frames": 2, "written": 2, "cut": 1}


def test_a_force_waits_for_the_complete_answer(board: Board) -> None:
    assert board.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
    board.read(frame(0.0, 0.0, 0.0)[:63])
    assert board.write(0.0, 0.0, 2.0, 0.0, 0.0, 0.0) == HELD and board.sent() == text(0, 0, 1000)
    assert board.write(*ZERO) == OK and board.sent() == text(0, 0, 0)
    assert board.write(*ZERO) == OK  # the board has zero already
    assert board.sent() == b""
    board.read(b"\n" + frame(0.0, 0.0, 0.0)[:62])
    assert board.write(0.0, 0.0, 2.0, 0.0, 0.0, 0.0) == HELD
    board.read(b" ")
    assert board.write(0.0, 0.0, 2.0, 0.0, 0.0, 0.0) == OK
    assert board.counts() == {"bytes": 127, "frames": 1, "written": 3, "held": 2}


def test_during_a_silence_only_a_zero_after_a_force_is_sent(board: Board) -> None:
    board.clock.now += 21 * MS
    assert board.write(*ZERO) == OK and board.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    assert board.sent() == b""
    board.word[BOARD.has_force] = 1
    assert board.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD and board.sent() == text(0, 0, 0)


def test_a_frame_that_went_out_in_part_is_finished_first(board: Board) -> None:
    board.port.room = 20
    assert board.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
    assert (board.word[BOARD.unsent_bytes], board.word[BOARD.has_force]) == (44, 1)
    assert board.write(*ZERO) == HELD
    board.port.room = 10
    assert board.write(*ZERO) == HELD
    assert not board.block.call(exchange.disarm_and_zero)  # not done until the pending force is sent
    board.port.room = 34
    assert board.write(*ZERO) == HELD  # frame completed, but no byte of the zero was accepted
    assert (board.word[BOARD.unsent_bytes], board.word[BOARD.has_force]) == (0, 1)
    assert board.sent() == text(0, 0, 1000) and board.counts() == {"written": 1}
    board.port.room = None
    assert board.block.call(exchange.disarm_and_zero) and board.sent() == text(0, 0, 0)
    assert board.counts() == {"written": 2}


def test_a_silent_board_is_woken_by_a_newline(board: Board) -> None:
    assert board.wake() == OK and board.sent() == b"\n"
    board.word[BOARD.has_force] = 1
    assert board.wake() == OK and board.sent() == text(0, 0, 0) + b"\n"
    assert board.counts() == {"kicks": 2, "written": 1}
    board.port.room = 0
    assert board.wake() == OK
    assert board.sent() == b"" and board.counts() == {"kicks": 2, "written": 1}
    board.word[BOARD.has_force] = 1
    assert board.wake() == HELD  # its force was not set to zero
    board.port.room = 20
    assert board.wake() == OK
    assert board.sent() == text(0, 0, 0)[:20]  # no newline in the middle of a frame
    assert board.wake() == HELD and board.counts() == {"kicks": 2, "written": 2}


# --- frames described in a rig ---


def described(**changes: Any) -> Options:
    fields = [("x", 1), ("y", 5), ("z", 9), ("qw", 13), ("qx", 17), ("qy", 21), ("qz", 25)]
    frames = {
        "mode": "answer",
        "resync": {"byte": 3, "count": 4},
        "input": {
            "bytes": 31, "start": [7],
            "field": [
                *({"meaning": m, "offset": at, "type": "float32"} for m, at in fields),
                {"meaning": "buttons", "offset": 29, "type": "uint8"},
                {"meaning": "gripper", "offset": 30, "type": "uint8", "scale": 0.01},
            ],
        },
        "output": {
            "bytes": 9, "start": [2],
            "field": [
                *(
                    {"meaning": f"force_{k}", "offset": 1 + 2 * n, "type": "int16", "scale": 1e4}
                    for n, k in enumerate("xyz")
                ),
                {"meaning": "constant", "offset": 7, "type": "int16", "scale": 258.0},
            ],
        },
    }  # fmt: skip
    keys = {
        "path": "/dev/ttyACM0", "force_max_n": 4.0, "stiffness_max_n_per_m": 900.0, "damping_max_ns_per_m": 3.0,
        "workspace_radius_m": 0.05, "frames": {**frames, **changes.pop("frames", {})}, "mounting": MOUNTING,
        "kinematics": {"kind": "cartesian"}, "quiet_s": 0.02, "timeout_s": 0.2,
    }  # fmt: skip
    return build(Options, {**keys, **changes}, "rig")


def answer(*numbers: float, buttons: int = 0, gripper: int = 0) -> bytes:
    place, q = numbers[:3], numbers[3:] or (1.0, 0.0, 0.0, 0.0)
    return b"\7" + struct.pack("<7fBB", *place, *q, buttons, gripper)


def force_frame(x: int, y: int, z: int) -> bytes:
    return b"\2" + struct.pack("<4h", x, y, z, 258)


@pytest.fixture
def board_of_rig(monkeypatch: pytest.MonkeyPatch) -> Board:
    return Board(described(), monkeypatch)


def test_a_force_is_written_as_described(board_of_rig: Board) -> None:
    for force, status, numbers in (
        ((0.5, -1.0, 2.0), OK, (-10000, -5000, 20000)),
        ((0.0, 0.0, -30.0), STALE, (0, 0, -32768)),  # the motors: 4 N, and the field: 3.2768 N
        ((0.0, 3.5, 0.0), STALE, (32767, 0, 0)),  # only the field
        ((0.0, 0.0, 0.0), OK, (0, 0, 0)),
    ):
        board_of_rig.read(answer(0.0, 0.0, 0.0))
        assert board_of_rig.write(*force, 3.0, 3.0, 3.0) == status
        assert board_of_rig.sent() == force_frame(*numbers)
    assert board_of_rig.counts() == {"bytes": 124, "frames": 4, "written": 4, "cut": 2}


def test_resync_bytes_follow_an_unanswered_frame(board_of_rig: Board) -> None:
    assert board_of_rig.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
    assert board_of_rig.sent() == force_frame(0, 0, 10000) and board_of_rig.write(*ZERO) == OK
    assert board_of_rig.sent() == b"\3" * 4 + force_frame(0, 0, 0) and board_of_rig.wake() == OK
    assert board_of_rig.sent() == b"\3" * 4 + force_frame(0, 0, 0)
    board_of_rig.read(answer(0.0, 0.0, 0.0))
    assert board_of_rig.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
    assert board_of_rig.sent() == force_frame(0, 0, 10000)
    assert board_of_rig.counts() == {"bytes": 31, "frames": 1, "written": 4, "kicks": 1}


def test_a_described_board_is_woken_after_its_frame(board_of_rig: Board) -> None:
    board_of_rig.port.room = 3
    assert board_of_rig.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK and board_of_rig.wake() == HELD
    assert "kicks" not in board_of_rig.counts()
    board_of_rig.port.room = None
    assert board_of_rig.wake() == OK
    assert board_of_rig.sent() == force_frame(0, 0, 10000) + b"\3" * 4 + force_frame(0, 0, 0)
    assert board_of_rig.counts() == {"written": 2, "kicks": 1}


def test_bytes_before_a_request_are_discarded(board_of_rig: Board) -> None:
    board_of_rig.read(b"\7\7\7")
    board_of_rig.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    status, sample = board_of_rig.read(answer(0.25, 0.0, 0.0))
    assert (status, sample[1]) == (OK, pytest.approx(0.45))
    assert board_of_rig.read()[0] == STALE
    assert [board_of_rig.read(bytes([byte]))[0] for byte in answer(0.25, 0.0, 0.0)] == [STALE] * 30 + [OK]


def test_byte_order_and_checksums_of_both_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    place = [{"meaning": m, "offset": 1 + 4 * n, "type": "float32"} for n, m in enumerate("xyz")]
    force = [{"meaning": f"force_{m}", "offset": 2 + 2 * n, "type": "int16", "scale": 1e4} for n, m in enumerate("xyz")]
    frames = {
        "order": "big",
        "input": {"bytes": 15, "start": [126], "check": {"kind": "crc16-ccitt", "offset": 13}, "field": place},
        "output": {"bytes": 9, "start": [85, 84], "check": {"kind": "crc8", "offset": 8}, "field": force},
    }
    board = Board(described(frames=frames, mounting={}), monkeypatch)
    head = b"\x7e" + struct.pack(">3f", 0.25, 0.5, -0.125)
    status, sample = board.read(head + struct.pack(">H", crc_hqx(head, 0xFFFF)))
    assert (status, sample[:3].tolist()) == (OK, [0.25, 0.5, -0.125])
    assert board.write(0.5, -1.0, 2.0, 0.0, 0.0, 0.0) == OK
    request = b"\x55\x54" + struct.pack(">3h", 5000, -10000, 20000)
    assert board.sent() == request + bytes([crc8(request)])


@pytest.mark.parametrize("mode", ["answer", "stream"])
def test_a_frame_with_marks_is_found_among_other_bytes(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = [{"meaning": m, "offset": 1 + 4 * n, "type": "float32"} for n, m in enumerate("xyz")]
    marked = {"mode": mode, "input": {"bytes": 14, "start": [7], "end": [9], "field": fields}}
    board = Board(described(frames=marked), monkeypatch)
    whole = b"\7" + struct.pack("<3f", 0.25, 0.0, 0.0) + b"\t"
    board.read(b"xx" + whole[:5])
    for force in (1.0, 2.0):
        assert board.write(0.0, 0.0, force, 0.0, 0.0, 0.0) == (OK if force == 1.0 or mode == "stream" else HELD)
    status, sample = board.read(whole[5:])
    assert (status, sample[1]) == (OK, pytest.approx(0.45))
    assert sample[3:7].tolist() == [1.0, 0.0, 0.0, 0.0]  # no orientation is sensed, so none is rotated
