"""Exchange of all board drivers, call by call, on a scripted board and clock: limits to the nanosecond; mechanisms
described in a rig, in the exchanges of both board drivers: joint angles in, torques out."""

import struct
from collections.abc import Callable, Iterable, Iterator
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import test_hid_exchange
import test_serial_exchange
from helpers.plain_by_call import BY_CALL, MS, START_NS, by_call
from numpy.typing import NDArray

from softfinger.drivers import base, board_exchange
from softfinger.drivers.base import HELD, LOST, OK, PROTOCOL, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.block import Block
from softfinger.drivers.board_exchange import BOARD, WAIT_MS, BoardTimes
from softfinger.drivers.samples import CURRENT_WAIT_MAX_NS, PAUSE_MIN_NS

pytestmark = BY_CALL

FD = 7
QUIET, KICK, TIMEOUT_NS = 20 * MS, 50 * MS, 200 * MS
TIMES = BoardTimes(0.02, 0.05, 0.025, 0.2)
OPENED = 9_000 * MS
FORCE = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0)
ZERO = (0.0,) * 6


class Board:
    """Scripted board and the calls it received.

    incoming  number of samples found by each following read; none once the list is empty
    arrives   times (ns of the clock) from which on a read finds one more sample
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.clock = by_call(patch, board_exchange)
        patch.setattr(board_exchange.time, "monotonic_ns", lambda: OPENED)
        patch.setattr(board_exchange, "wait_readable", self._wait_readable)
        for kernel in ("drain", "convert_sample", "must_withhold", "send_zero", "send_wrench", "wake"):
            patch.setattr(board_exchange, kernel, getattr(self, kernel))
        self.block = Block(BOARD, BOARD)
        self.clock.room = {self.block.handle + 8 * BOARD.timespec}
        self._functions = board_exchange.compile_functions(())
        self.calls: list[Any] = []
        self.incoming: list[int] = []
        self.arrives: list[int] = []
        self.usable, self.busy = True, False
        self.zero, self.force, self.woken = OK, OK, OK
        self.wake_ends_a_force = False
        self.sample = np.zeros(base.SAMPLE_SIZE)
        board_exchange.init_exchange(self.block, FD, TIMES, misread_max=8)

    def _wait_readable(self, fd: int, wait_ms: int, word: int) -> bool:
        assert (fd, word) == (self.word[BOARD.fd], self.block.handle + 8 * BOARD.poll)
        self._record(f"wait {wait_ms}")
        self.clock.now += wait_ms * MS
        return False

    def _record(self, call: Any) -> None:
        self.calls.append(call)
        assert len(self.calls) < 200, "it waits for ever"

    def drain(self, driver: Any, handle: int) -> int:
        self._record("drain")
        if self.arrives and self.clock.now >= self.arrives[0]:
            self.arrives.pop(0)
            return 1
        return self.incoming.pop(0) if self.incoming else 0

    def convert_sample(self, driver: Any, handle: int) -> bool:
        self.block.numbers(BOARD.sample, base.SAMPLE_SIZE)[0] += 1.0  # each sample has another position
        return self.usable

    def must_withhold(self, driver: Any, handle: int, deaf: bool) -> bool:
        self._record(f"busy? {'deaf' if deaf else 'hears'}")
        return self.busy

    def send_zero(self, driver: Any, handle: int) -> int:
        self._record("zero")
        self.word[BOARD.has_force] = 0
        return self.zero

    def send_wrench(self, driver: Any, handle: int, wrench: Any) -> int:
        self._record(tuple(wrench))
        self.word[BOARD.has_force] = 1
        return self.force

    def wake(self, driver: Any, handle: int) -> int:
        self._record(("wake", self.clock.now))
        if self.wake_ends_a_force:
            self.word[BOARD.has_force] = 0
        return self.woken

    @property
    def word(self) -> NDArray[np.int64]:
        return self.block.word

    def read(self) -> int:
        self.calls = []
        return int(self._functions.read(self.block.handle, self.sample))

    def write(self, wrench: tuple[float, ...]) -> int:
        self.calls = []
        return int(self._functions.write(self.block.handle, wrench))

    def disarm_and_zero(self) -> int:
        self.calls = []
        return int(self._functions.disarm_and_zero(self.block.handle))

    def receive_sample(self) -> None:
        self.incoming = [0, 0, 1]
        assert self.read() == OK

    def later(self, ns: int) -> None:
        self.clock.now += ns
        self.word[BOARD.read_at] = self.clock.now


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Iterator[Board]:
    made = Board(monkeypatch)
    yield made
    assert made.word[BOARD.lock] == 0


# --- first sample, and sample after a pause ---


def test_a_device_that_is_closed_is_lost(board: Board) -> None:
    board.word[BOARD.fd] = -1
    assert board.read() == LOST and board.calls == []
    assert (board.write(ZERO), board.write(FORCE)) == (OK, WITHHELD) and board.calls == []
    assert board.disarm_and_zero() == 1 and board.calls == []
    board.word[BOARD.fd] = 0
    assert board.write(ZERO) == OK and board.calls == ["busy? deaf", "zero"]
    assert board.disarm_and_zero() == 1 and board.calls == ["zero"]
    board.receive_sample()


def test_first_read_discards_queued_samples_and_waits(board: Board) -> None:
    board.incoming, board.arrives = [3, 2], [START_NS + 62 * MS]
    board.word[BOARD.kicked_at] = START_NS - 1
    assert board.read() == OK
    waits = ["wait 10", "drain"]
    expected: list[Any] = ["drain", "wait 0", "drain", ("wake", START_NS)]
    expected += 3 * waits + [("wake", START_NS + 30 * MS)] + 3 * waits + [("wake", START_NS + 60 * MS)] + waits
    assert board.calls == expected
    assert board.sample[base.SAMPLE_TIME] == pytest.approx((START_NS + 70 * MS - OPENED) * 1e-9, rel=1e-15)


@pytest.mark.parametrize("reads", [0, 1, 2])
def test_a_loss_during_the_first_read_is_reported_at_once(reads: int, board: Board) -> None:
    board.incoming = [0] * reads + [LOST]
    assert board.read() == LOST
    calls: list[Any] = ["drain", "wait 0", "drain", ("wake", START_NS), "wait 10", "drain"]
    assert board.calls == calls[: (1, 3, 6)[reads]]


@pytest.mark.parametrize("status", [LOST, OK, HELD])
def test_a_wake_that_fails_ends_the_wait(status: int, board: Board) -> None:
    board.woken, board.arrives = status, [START_NS + 5 * MS]
    assert board.read() == (status if status < 0 else OK)


@pytest.mark.parametrize(("misread", "status"), [(0, TIMEOUT), (7, TIMEOUT), (8, PROTOCOL), (9, PROTOCOL)])
def test_first_read_times_out(misread: int, status: int, board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = board.word[BOARD.misread_bytes] = 100
    real = board_exchange.drain

    def drain(driver: Any, handle: int) -> int:
        board.word[BOARD.misread_bytes] = begun + (misread if board.clock.now > START_NS else 0)
        return int(real(driver, handle))

    monkeypatch.setattr(board_exchange, "drain", drain)
    assert board.read() == status and board.clock.now == START_NS + TIMEOUT_NS + WAIT_MS * MS
    assert board.calls.count("drain") == 2 + 21


@pytest.mark.parametrize(("ns", "paused"), [(PAUSE_MIN_NS, False), (PAUSE_MIN_NS + 1, True)])
def test_a_pause_of_the_loop_is_longer_than_resume_ns(ns: int, paused: bool, board: Board) -> None:
    board.receive_sample()
    board.clock.now += ns
    board.incoming = [1, 0, 1]
    assert board.read() == OK
    assert board.calls == (["drain", "wait 0", "drain", ("wake", board.clock.now - 10 * MS), "wait 10", "drain"]
                          if paused else ["drain"])  # fmt: skip


def test_after_a_pause_a_silent_board_costs_a_short_wait_and_gets_no_force(board: Board) -> None:
    board.receive_sample()
    board.clock.now += 150 * MS
    begun, before = board.clock.now, board.sample.copy()
    assert board.read() == STALE and board.clock.now - begun == CURRENT_WAIT_MAX_NS + WAIT_MS * MS
    assert board.sample.tolist() == before.tolist() and board.word[BOARD.read_at] == board.clock.now
    assert board.word[BOARD.sampled_at] == begun - QUIET - 1
    assert board.write(FORCE) == WITHHELD and "zero" in board.calls
    board.later(MS)
    board.incoming = [1]
    assert board.read() == OK and board.write(FORCE) == OK and board.calls == [FORCE]


# --- ticks ---


def test_a_tick_reads_the_latest_sample_without_waiting(board: Board) -> None:
    board.receive_sample()
    board.later(MS)
    board.incoming = [4]
    assert board.read() == OK and board.calls == ["drain"]
    assert board.sample[base.SAMPLE_TIME] == pytest.approx((board.clock.now - OPENED) * 1e-9, rel=1e-15)
    assert board.sample[0] == 2.0
    sample = board.sample.copy()
    board.later(MS)
    assert board.read() == STALE and board.calls == ["drain"]
    assert board.sample.tolist() == sample.tolist()


def test_an_unusable_sample_is_a_protocol_error(board: Board) -> None:
    board.receive_sample()
    board.later(MS)
    board.incoming, board.usable = [1], False
    assert board.read() == PROTOCOL
    board.incoming = [LOST]
    assert board.read() == LOST


@pytest.mark.parametrize(("misread", "status"), [(7, TIMEOUT), (8, PROTOCOL)])
def test_a_silence_longer_than_the_time_out_is_a_failure(misread: int, status: int, board: Board) -> None:
    board.receive_sample()
    board.word[BOARD.misread_bytes] = misread
    for later, wanted in ((TIMEOUT_NS, STALE), (1, status)):
        board.later(later)
        assert board.read() == wanted


def test_a_silent_board_is_woken_repeatedly(board: Board) -> None:
    board.receive_sample()
    board.word[BOARD.kicked_at] = START_NS - KICK
    for later, wakes in ((QUIET, False), (1, True), (KICK - 1, False), (1, True)):
        board.later(later)
        assert board.read() == STALE and board.calls == ["drain"] + [("wake", board.clock.now)] * wakes
    board.later(KICK)
    board.woken = LOST
    assert board.read() == LOST


def test_nothing_is_sent_while_the_device_is_being_stopped(board: Board) -> None:
    board.receive_sample()
    board.word[BOARD.kicked_at] = START_NS - KICK
    board.later(QUIET + 1)
    board.word[BOARD.lock] = 1
    assert board.read() == STALE and board.calls == ["drain"]
    board.incoming = [1]
    assert board.read() == OK
    assert board.write(FORCE) == WITHHELD and board.write(ZERO) == WITHHELD and board.calls == []
    assert board.disarm_and_zero() == 0 and board.calls == [] and board.word[BOARD.armed] == 0
    assert board.word[BOARD.lock] == 1
    board.word[BOARD.lock] = 0


def test_a_wake_that_clears_a_force_is_reported(board: Board) -> None:
    board.receive_sample()
    assert board.write(FORCE) == OK
    board.word[BOARD.kicked_at], board.wake_ends_a_force = START_NS - KICK, True
    board.later(QUIET + 1)
    assert board.read() == WITHHELD and board.read() == STALE
    board.later(MS)
    board.incoming = [1]
    assert board.read() == OK


# --- forces ---


@pytest.mark.parametrize("status", [OK, STALE, HELD, LOST])
def test_a_force_is_sent_and_the_driver_status_returned(status: int, board: Board) -> None:
    board.receive_sample()
    board.later(QUIET)
    board.force = status
    assert board.write(FORCE) == status and board.calls == [FORCE]


@pytest.mark.parametrize("why", ["silent", "not armed", "no sample"])
@pytest.mark.parametrize("status", [OK, HELD, LOST])
def test_a_zero_replaces_a_withheld_force(why: str, status: int, board: Board) -> None:
    board.receive_sample()
    board.later(QUIET + (why == "silent"))
    board.word[BOARD.armed], board.word[BOARD.has_sample] = why != "not armed", why != "no sample"
    board.zero = status
    assert board.write(FORCE) == (status if status < 0 else WITHHELD)
    assert board.calls == ["busy? hears" if why == "not armed" else "busy? deaf", "zero"]


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("number", [nan, inf, -inf])
def test_a_force_that_is_not_finite_is_a_zero(place: int, number: float, board: Board) -> None:
    board.receive_sample()
    wrench = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    wrench[place] = number
    assert board.write(tuple(wrench)) == WITHHELD and board.calls == ["busy? hears", "zero"]
    assert board.write((0.0, 0.0, 0.0, 1.0, 0.0, 0.0)) == OK and board.calls == ["busy? hears", "zero"]
    force = (0.0, 0.0, 1.0, nan, 0.0, 0.0)
    assert board.write(force) == OK and len(board.calls) == 1 and board.calls[0][:3] == force[:3]


@pytest.mark.parametrize("place", [0, 1, 2])
def test_the_smallest_force_along_one_axis_is_sent(place: int, board: Board) -> None:
    board.receive_sample()
    wrench = tuple(5e-324 * (k == place) for k in range(6))
    assert board.write(wrench) == OK and board.calls == [wrench]


def test_a_busy_board_gets_only_a_zero_that_ends_a_force(board: Board) -> None:
    board.receive_sample()
    board.busy = True
    assert board.write(ZERO) == OK and board.calls == ["busy? hears"]
    board.later(QUIET + 1)
    assert board.write(FORCE) == WITHHELD and board.calls == ["busy? deaf"]
    board.word[BOARD.has_force] = 1
    assert board.write(ZERO) == OK and board.calls == ["zero"]


@pytest.mark.parametrize(("status", "unsent_bytes", "succeeded"), [(OK, 0, 1), (HELD, 0, 0), (OK, 1, 0), (LOST, 0, 1)])
def test_silence_succeeds_once_the_zero_is_sent(status: int, unsent_bytes: int, succeeded: int, board: Board) -> None:
    board.receive_sample()
    board.zero, board.word[BOARD.unsent_bytes] = status, unsent_bytes
    assert board.disarm_and_zero() == succeeded and board.calls == ["zero"]
    assert board.word[BOARD.armed] == 0 and board.word[BOARD.lock] == 0
    board.zero = OK
    assert board.write(FORCE) == WITHHELD


PANTOGRAPH = {"kind": "pantograph", "base_m": 0.038, "inner_m": 0.07, "outer_m": 0.0875, "torque_max_nm": 0.01}
DELTA = {
    "kind": "delta", "base_m": 0.06, "end_m": 0.03, "arm_m": 0.08, "rod_m": 0.17, "torque_max_nm": 0.2,
    "origin_m": [0.0, 0.0, 0.2],
}  # fmt: skip


class Joints:
    """A board of either driver, with a float32 per joint in its messages."""

    def __init__(self, driver: str, kinematics: dict[str, Any], names: str, patch: pytest.MonkeyPatch) -> None:
        messages = {
            direction: {
                "bytes": 4 * len(names),
                "field": [{"meaning": f"{m}{n}", "offset": 4 * k, "type": "float32"} for k, n in enumerate(names)],
            }
            for direction, m in (("input", ""), ("output", "torque_"))
        }
        keys: dict[str, Any] = {"kinematics": kinematics, "mounting": {}}
        self.format, self.board = f"<{len(names)}f", self.open(driver, keys, messages, patch)

    def open(self, driver: str, keys: Any, messages: Any, patch: pytest.MonkeyPatch) -> Any:
        if driver == "hid":
            return test_hid_exchange.Board(patch, **keys, reports=messages)
        return test_serial_exchange.Board(test_serial_exchange.described(**keys, frames=messages), patch)

    def read(self, angles: Iterable[float]) -> Any:
        return self.board.read(struct.pack(self.format, *angles))

    def torques(self, *force: float) -> tuple[int, np.ndarray]:
        """Return the status of a force, and the torques (N m) sent for it."""
        status = self.board.write(*force, 0.0, 0.0, 0.0)
        sent = self.board.node.sent if isinstance(self.board, test_hid_exchange.Board) else self.board.port.sent
        return status, np.array(struct.unpack(self.format, sent[-1][-struct.calcsize(self.format) :]))

    def count(self, name: str) -> int:
        return int(self.board.counts().get(name, 0))


Make = Callable[[dict[str, Any], str], Joints]


@pytest.fixture(params=["serial", "hid"])
def make(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Make:
    return lambda kinematics, names: Joints(request.param, kinematics, names, monkeypatch)


def test_a_singular_pose_is_counted_and_a_motors_limit_is_another(make: Make) -> None:
    joints = make(PANTOGRAPH, "ab")
    # first, both inner links outward along the line of their joints: their ends are 0.178 m apart, beyond the reach of
    # the outer links
    for degrees, largest, counts in (((180.0, 0.0), 0.0, (1, 0)), ((150.0, 30.0), 0.01, (1, 1))):
        for force, status in ((5.0, STALE), (0.0, OK)):  # a zero needs no motor
            assert joints.read(np.radians(degrees))[0] == OK
            outcome, torques = joints.torques(0.0, force, 0.0)
            assert outcome == status
            assert np.abs(torques).max() == pytest.approx(largest if force else 0.0)
        assert (joints.count("singular"), joints.count("cut")) == counts
    assert joints.count("written") == 4


def test_a_pose_that_is_none_is_counted_as_singular(make: Make) -> None:
    joints = make(DELTA, "abc")
    status, sample = joints.read((0.0, np.pi, 0.0))
    assert status == OK and np.isnan(sample[:3]).all()
    assert joints.count("singular") == 1 and np.isfinite(joints.read((0.5, 0.5, 0.5))[1]).all()
    assert joints.count("singular") == 1


def test_torques_of_a_delta_do_the_work_of_the_force(make: Make) -> None:
    joints = make(DELTA, "abc")
    angles, step, force = np.array([0.5, 0.6, 0.4]), np.array([1e-3, -2e-3, 3e-3]), np.array([0.3, -0.2, 0.5])
    ahead, behind = (joints.read(angles + sign * step)[1][:3] for sign in (1, -1))
    joints.read(angles)
    status, torques = joints.torques(*force)
    assert status == OK and (torques != 0.0).all()
    # an error of the third order in steps of 3e-3
    assert torques @ (2 * step) == pytest.approx(force @ (ahead - behind), rel=1e-4)
