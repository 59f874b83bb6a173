"""Exchange with a Falcon, call by call, on a scripted libusb and clock: limits to the nanosecond."""

from math import inf, isnan, nan
from typing import Any

import numpy as np
import pytest
from helpers.plain_by_call import BY_CALL, MS, START_NS, FarEnd, GuardedBlock, by_call

from softfinger.drivers.base import HELD, LOST, OK, SAMPLE_SIZE, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.falcon import exchange, packets
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.conversion import HOME, compute_command
from softfinger.drivers.samples import CURRENT_WAIT_MAX_NS

pytestmark = BY_CALL

CONTEXT, SUBMIT, STOPS_MAX, CANCEL = 70, 71, 72, 73
KICK, TIMEOUT_NS = 20 * MS, 200 * MS
LOST_NS = 5 * MS
"""Age after which an answer counts as lost."""
COMPLETED, BROKEN, TIMED_OUT, CANCELLED, STALLED, NO_DEVICE = 0, 1, 2, 3, 4, 5
"""Transfer states of libusb."""
ERROR_IO, ERROR_NO_DEVICE, ERROR_INTERRUPTED = -1, -4, -10
ZERO = (0.0,) * 6
PULL = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
STATUS = b"\x01\x60"
"""Two status bytes that the serial chip puts in front of every transfer."""


def packet(numbers: tuple[int, ...], state: int) -> bytes:
    nibbles = [0x41 + ((n >> (4 * k)) & 15) for n in numbers for k in range(4)]
    return bytes([0x3C, *nibbles, 0x41 + state, 0x41, 0x3E])


def reply(count: int = 0) -> bytes:
    return packet((count,) * 3, 0x70)


def counts_of(sent: bytes) -> tuple[int, ...]:
    nibbles = [byte - 0x41 for byte in sent[1:13]]
    whole = [sum(n << (4 * k) for k, n in enumerate(nibbles[at : at + 4])) for at in (0, 4, 8)]
    return tuple(n - 65536 if n >= 32768 else n for n in whole)


NOTHING = packet((0, 0, 0), 2)
"""Zero with the green light."""


class Usb(FarEnd):
    """Scripted libusb, and the block of a driver that is homed and armed.

    incoming  data of the incoming transfers; None: the transfer ends with state `ends`
    answers   add the next reply whenever handling of events completes a packet
    """

    exchange = exchange

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.clock = by_call(patch, exchange)
        patch.setattr(exchange, "call_int32", self._call)
        self.block = GuardedBlock(AT)
        word = self.block.word
        self.clock.room = {self.block.handle + 8 * AT.timespec}
        self.transfers = {at: np.zeros(8, np.int64) for at in (AT.transfer_in, AT.transfer_out)}
        for at, done_word in ((AT.transfer_in, AT.in_done), (AT.transfer_out, AT.out_done)):
            word[at] = self.transfers[at].ctypes.data
            self.transfers[at][5] = self.block.handle + 8 * done_word  # user_data
        word[AT.context], word[AT.submit], word[AT.handle_events], word[AT.cancel] = CONTEXT, SUBMIT, STOPS_MAX, CANCEL
        word[AT.kick], word[AT.timeout_after], word[AT.lights] = KICK, TIMEOUT_NS, packets.GREEN
        word[AT.open] = word[AT.armed] = word[AT.in_done] = word[AT.out_done] = word[AT.homed] = 1
        word[AT.opened_at] = START_NS - 2000 * MS
        self.block.numbers(AT.centre, 3)[:] = (0.0, 0.0, 0.11)
        self.block.numbers(AT.gain, 1)[:] = 10000.0
        self.block.numbers(AT.position, 3)[:] = HOME
        self.incoming: list[bytes | None] = []
        self.ends, self.answers, self.blocked, self.stubborn, self.error = BROKEN, True, False, False, 0
        self.interrupted = False
        self.waits: list[int] = []
        self.sent: list[bytes] = []
        self.cancelled: list[int] = []
        self.number = 0
        assert self.block.call(exchange.start_reading) == OK

    def _done(self, at: int, status: int, actual: int = 0) -> None:
        self.transfers[at].view(np.int32)[4] = status
        self.transfers[at].view(np.int32)[6] = actual
        exchange.on_complete(int(self.word[at]))

    def _call(self, address: int, arguments: tuple[Any, ...]) -> int:
        assert self.word[AT.lock] == 1 or address == SUBMIT
        if address == STOPS_MAX:
            return self._events(*arguments)
        (transfer,) = arguments
        at = AT.transfer_in if transfer == self.word[AT.transfer_in] else AT.transfer_out
        assert transfer == self.word[at]
        if address == CANCEL:
            self.cancelled.append(at)
            return 0
        assert address == SUBMIT
        assert self.word[AT.in_done if at == AT.transfer_in else AT.out_done] == 0
        if self.error:
            return self.error
        if at == AT.transfer_out:
            self.sent.append(self.block.raw_bytes(AT.buffer_out, packets.SIZE).tobytes())
        return 0

    def _events(self, context: int, interval: Any, completed: Any) -> int:
        assert context == CONTEXT and interval[0] == 0 and not completed
        self.waits.append(interval[1])
        assert len(self.waits) < 500, "it waits for ever"
        if self.interrupted:
            return ERROR_INTERRUPTED
        if self.error:
            return self.error
        for at, done_word in ((AT.transfer_in, AT.in_done), (AT.transfer_out, AT.out_done)):
            if at in self.cancelled and not self.word[done_word] and not self.stubborn:
                self._done(at, CANCELLED)
        if not self.word[AT.out_done] and not self.blocked:
            self._done(AT.transfer_out, COMPLETED, packets.SIZE)
            if self.answers:
                self.number += 1
                self.incoming.append(reply(self.number))
        if self.word[AT.in_done] or not self.incoming:
            self.clock.now += 1000 * interval[1]
            return 0
        data = self.incoming.pop(0)
        if data is None:
            self._done(AT.transfer_in, self.ends)
        else:
            whole = STATUS + data
            self.block.raw_bytes(AT.buffer_in, 64)[: len(whole)] = list(whole[:64])
            self._done(AT.transfer_in, COMPLETED, len(whole))
        return 0

    def read(self, *incoming: bytes) -> tuple[int, np.ndarray]:
        self.incoming += incoming
        self.waits.clear()
        status, sample = super().read()
        assert self.word[AT.lock] == 0
        return status, sample

    def write(self, *wrench: float) -> int:
        self.waits.clear()
        status = super().write(*wrench)
        assert self.word[AT.lock] == 0
        return status

    def later(self, ns: int) -> None:
        self.clock.now += ns
        self.word[AT.read_at] = self.clock.now

    def got(self) -> list[bytes]:
        """Return the packets sent since the last call."""
        out = self.sent[:]
        self.sent.clear()
        return out

    def forces(self) -> dict[str, int]:
        return {name: n for name, n in self.counts().items() if name in ("written", "held", "kicks", "cut")}


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Usb:
    return Usb(monkeypatch)


@pytest.fixture
def usb(opened: Usb) -> Usb:
    assert opened.read()[0] == OK
    opened.answers = False
    opened.sent.clear()
    opened.word[: AT.context] = 0
    return opened


# --- first sample, and sample after a pause ---


def test_the_first_read_times_out(opened: Usb) -> None:
    opened.answers = False
    assert opened.read()[0] == TIMEOUT and TIMEOUT_NS < opened.clock.now - START_NS <= TIMEOUT_NS + 2 * MS
    assert opened.got() == [NOTHING] * 11


def test_after_a_pause_old_replies_are_discarded(usb: Usb) -> None:
    assert usb.write(*PULL) == OK
    usb.clock.now += 31 * MS
    usb.answers = False
    replies = iter([[], [reply(100)], [reply(200)]])
    events = usb._events

    def late(*arguments: Any) -> int:
        usb.incoming += next(replies, []) if arguments[1][1] else []
        return events(*arguments)

    usb._events = late
    status, sample = usb.read()
    assert status == WITHHELD
    assert usb.word[AT.counts] == 200
    assert np.isfinite(sample).all()
    assert counts_of(usb.got()[-1]) == (0, 0, 0) and usb.read(reply(300))[0] == OK


def test_a_pause_of_the_loop_is_no_silence_of_the_device(usb: Usb) -> None:
    before = usb.read(reply(5))[1].tolist()
    usb.got()
    usb.clock.now += 3 * TIMEOUT_NS
    begun = usb.clock.now
    status, sample = usb.read()
    assert (status, sample.tolist()) == (WITHHELD, before)
    assert CURRENT_WAIT_MAX_NS < usb.clock.now - begun <= CURRENT_WAIT_MAX_NS + 2 * MS
    assert usb.got() == [NOTHING] * 6 and usb.write(*PULL) == WITHHELD
    usb.later(1 * MS)
    assert usb.read(reply(6))[0] == OK


# --- replies ---


def test_a_reply_is_a_sample_that_is_repeated(usb: Usb) -> None:
    status, first = usb.read(reply(5))
    assert status == OK
    assert set(usb.waits) == {0}
    status, second = usb.read()
    assert (status, second.tolist()) == (STALE, first.tolist())
    assert [usb.read(part)[0] for part in (reply(6)[:7], reply(6)[7:])] == [STALE, OK]
    assert usb.counts() == {"replies": 2}


def test_the_last_reply_of_a_tick_is_used(usb: Usb) -> None:
    assert usb.read(reply(1) + reply(2), b"", reply(3))[0] == OK and usb.word[AT.counts] == 3
    assert usb.counts() == {"replies": 3, "passed": 2}


def test_a_flood_does_not_delay_the_loop(usb: Usb) -> None:
    assert usb.read(*[reply(n) for n in range(20)])[0] == OK and usb.counts() == {"replies": 8, "passed": 7}


def test_a_length_past_the_buffer_is_clamped(usb: Usb) -> None:
    usb.write(*ZERO)
    usb.block.raw_bytes(AT.buffer_in, 64)[:] = 0
    usb._done(AT.transfer_in, COMPLETED, 200)
    usb.blocked = True
    assert usb.read()[0] == STALE and "replies" not in usb.counts()
    assert usb.counts()["garbled"] == 62


@pytest.mark.parametrize(
    ("ends", "status", "error"),
    [
        (TIMED_OUT, STALE, 0), (CANCELLED, STALE, 0), (BROKEN, LOST, BROKEN), (STALLED, LOST, STALLED), (6, LOST, 6),
        (NO_DEVICE, LOST, ERROR_NO_DEVICE),
    ],
)  # fmt: skip
def test_statuses_of_a_transfer_from_the_device(ends: int, status: int, error: int, usb: Usb) -> None:
    usb.ends = ends
    usb.incoming = [None]
    assert usb.read()[0] == status and usb.word[AT.error] == error


def test_an_error_during_events_is_a_fault_unless_it_is_a_signal(usb: Usb) -> None:
    usb.interrupted = True
    assert usb.read(reply(1))[0] == STALE
    usb.interrupted = False
    assert usb.read()[0] == OK
    usb.error = ERROR_IO
    assert usb.read()[0] == LOST and usb.word[AT.error] == ERROR_IO


def test_a_rejected_transfer_is_not_pending(usb: Usb) -> None:
    def refuse(address: int, arguments: tuple[Any, ...]) -> int:
        return ERROR_IO if address == SUBMIT else usb._call(address, arguments)

    for knob in (AT.in_done, AT.out_done):
        usb.word[AT.error] = 0
        exchange.call_int32 = refuse
        assert (usb.read(reply(1))[0] if knob == AT.in_done else usb.write(*PULL)) == LOST
        assert usb.word[knob] == 1 and usb.word[AT.error] == ERROR_IO
        exchange.call_int32 = usb._call
        assert usb.block.call(exchange.start_reading) == OK
    assert usb.forces() == {}


def test_a_device_that_is_closed_is_lost(usb: Usb) -> None:
    usb.word[AT.open] = 0
    assert usb.read()[0] == LOST and usb.write(*ZERO) == OK
    assert usb.write(*PULL) == WITHHELD
    assert usb.waits == [] and usb.got() == []


def test_calls_during_a_stop_do_not_wait(usb: Usb) -> None:
    before = usb.read(reply(5))[1].tolist()
    usb.word[AT.lock] = 1
    sample = np.full(SAMPLE_SIZE, nan)
    assert usb.block.call(exchange.read, sample) == STALE and sample.tolist() == before
    assert usb.block.call(exchange.write, PULL) == WITHHELD and usb.block.call(exchange.disarm_and_zero) == 0
    assert usb.block.call(exchange.cancel_transfers) == 0
    assert usb.got() == [] and usb.word[AT.lock] == 1 and usb.word[AT.open] == 1


# --- forces ---


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_force_is_sent_as_motor_counts(axis: int, usb: Usb) -> None:
    wrench = [0.0, 0.0, 0.0, 0.5, 0.5, 0.5]
    wrench[axis] = 1.0
    wanted, cut = compute_command(usb.block.handle, tuple(wrench[:3]))
    assert any(wanted) and not cut
    assert usb.write(*wrench) == OK and usb.got() == [packet(wanted, 2)]
    assert usb.write(0.0, 0.0, 0.0, 1.0, 1.0, 1.0) == OK and usb.got() == [NOTHING]
    assert usb.forces() == {"written": 2}


@pytest.mark.parametrize("leg", [0, 1, 2])
def test_a_force_of_one_motor_has_to_be_ended(leg: int, usb: Usb, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = [0, 0, 0]
    counts[leg] = 1
    monkeypatch.setattr(exchange, "compute_command", lambda handle, force: (tuple(counts), False))
    assert usb.write(*PULL) == OK and usb.word[AT.has_force] == 1
    usb.write(*PULL)
    assert usb.write(*PULL) == HELD and usb.write(*ZERO) == OK
    assert usb.word[AT.has_force] == 0


def test_a_force_past_the_motors_is_limited(usb: Usb) -> None:
    assert usb.write(0.0, 0.0, 100.0, 0.0, 0.0, 0.0) == STALE and max(map(abs, counts_of(usb.got()[0]))) == 4095
    assert usb.forces() == {"written": 1, "cut": 1}


def test_two_packets_may_be_without_an_answer(usb: Usb) -> None:
    assert [usb.write(*PULL) for _ in range(3)] == [OK, OK, HELD] and usb.write(*ZERO) == OK
    assert usb.write(*ZERO) == STALE and usb.write(*PULL) == HELD
    assert [any(counts_of(data)) for data in usb.got()] == [True, True, False]
    assert usb.forces() == {"written": 3, "held": 3}
    for number, status in ((1, HELD), (2, OK)):
        assert usb.read(reply(number))[0] == OK and usb.write(*PULL) == status


def test_missing_answers_are_lost_after_five_ms(usb: Usb) -> None:
    usb.write(*ZERO)
    usb.write(*ZERO)
    for later, unanswered in ((LOST_NS, 2), (1, 0)):
        usb.later(later)
        assert usb.read()[0] == STALE and usb.word[AT.unanswered] == unanswered


def test_a_pending_packet_delays_the_next(usb: Usb) -> None:
    usb.blocked = True
    assert usb.write(*PULL) == OK and usb.write(*PULL) == HELD
    assert usb.waits == [0]
    assert usb.write(*ZERO) == HELD  # the motors retain their force
    assert usb.forces() == {"written": 1, "held": 2}
    usb.word[AT.sampled_at] = usb.clock.now = usb.clock.now + TIMEOUT_NS
    assert usb.write(*PULL) == HELD
    usb.clock.now += 1
    assert usb.write(*PULL) == TIMEOUT
    usb.blocked = False
    assert usb.write(*PULL) == OK


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_force_that_is_no_number_is_a_zero(axis: int, bad: float, usb: Usb) -> None:
    wrench = [0.0, 0.0, 0.0, bad, bad, bad]
    wrench[axis] = bad
    assert usb.write(*wrench) == WITHHELD and usb.got() == [NOTHING]
    wrench[axis] = 1.0
    assert usb.write(*wrench) == OK


def test_no_force_without_a_position(usb: Usb) -> None:
    status, sample = usb.read(reply(-3000))
    assert status == OK and isnan(sample[0])
    assert usb.write(*PULL) == WITHHELD and usb.write(*ZERO) == WITHHELD
    assert usb.got() == [NOTHING] * 2


def test_no_force_during_a_silence(usb: Usb) -> None:
    usb.read(reply(1))
    usb.later(KICK)
    assert usb.write(*PULL) == OK
    usb.later(1)
    assert [usb.write(*PULL), usb.write(*ZERO)] == [WITHHELD] * 2
    assert [any(counts_of(data)) for data in usb.got()] == [True, False]
    usb.word[AT.has_sample], usb.word[AT.sampled_at] = 0, usb.clock.now
    assert usb.write(*PULL) == WITHHELD


def test_only_an_armed_device_applies_a_force(usb: Usb) -> None:
    for armed, stopped in ((0, 0), (1, 1), (0, 1)):
        usb.word[AT.armed], usb.word[AT.stopped] = armed, stopped
        usb.word[AT.unanswered] = 0
        assert usb.write(*PULL) == WITHHELD and usb.write(*ZERO) == OK
        assert usb.got() == [NOTHING] * 2
    usb.word[AT.unanswered] = 2
    assert usb.write(*ZERO) == STALE and usb.write(*PULL) == WITHHELD
    assert usb.got() == []


# --- silences ---


def test_a_silence_is_kicked_and_times_out(usb: Usb) -> None:
    usb.read(reply(1))
    usb.write(*PULL)
    usb.word[AT.stale_replies] = 1
    for later, status in ((KICK, STALE), (1, WITHHELD), (0, STALE), (KICK, STALE), (1, WITHHELD)):
        usb.later(later)
        assert usb.read()[0] == status
        assert status == STALE or [usb.word[at] for at in (AT.unanswered, AT.stale_replies)] == [1, 0]
    assert [any(counts_of(data)) for data in usb.got()] == [True, False, False]
    assert usb.forces() == {"written": 3, "kicks": 2}
    usb.word[AT.sampled_at] = usb.clock.now - TIMEOUT_NS
    usb.word[AT.sent_at] = usb.clock.now
    assert usb.read()[0] == STALE
    usb.later(1)
    assert usb.read()[0] == TIMEOUT


# --- shutdown ---


def stop(usb: Usb) -> int:
    usb.waits.clear()
    return usb.block.call(exchange.disarm_and_zero)


def test_a_stop_sends_a_zero_and_waits_for_it(usb: Usb) -> None:
    usb.write(*PULL)
    usb.got()
    assert stop(usb) == 0 and usb.waits == [2000]
    assert usb.got() == [NOTHING] and [usb.word[at] for at in (AT.stopped, AT.armed, AT.lock)] == [1, 0, 0]
    assert stop(usb) == 1
    assert usb.got() == [] and usb.cancelled == []
    usb.word[AT.open], usb.word[AT.has_force] = 0, 1
    assert stop(usb) == 1 and usb.got() == []


def test_a_failed_zero_is_repeated(usb: Usb) -> None:
    usb.transfers[AT.transfer_out].view(np.int32)[4] = CANCELLED
    assert stop(usb) == 0 and usb.got() == [NOTHING]
    assert stop(usb) == 1
    usb.transfers[AT.transfer_out].view(np.int32)[4] = BROKEN
    usb.error = ERROR_NO_DEVICE
    assert stop(usb) == 1


def test_a_pending_force_is_cancelled(usb: Usb) -> None:
    usb.blocked = True
    usb.write(*PULL)
    usb.got()
    usb.clock.now = int(usb.word[AT.sent_at]) + exchange.STOP_HANG_NS - 2 * MS  # the wait takes 2 ms of it
    assert stop(usb) == 0 and usb.cancelled == []
    assert stop(usb) == 0 and usb.cancelled == [AT.transfer_out]
    assert stop(usb) == 0 and usb.got() == [NOTHING]


def test_closing_cancels_both_transfers(usb: Usb) -> None:
    assert usb.block.call(exchange.cancel_transfers) == 1 and usb.cancelled == [AT.transfer_in]
    assert [usb.word[at] for at in (AT.open, AT.in_done, AT.out_done, AT.lock)] == [0, 1, 1, 0]
    usb.cancelled.clear()
    assert usb.block.call(exchange.cancel_transfers) == 1 and usb.cancelled == []


@pytest.mark.parametrize("hangs", [AT.transfer_in, AT.transfer_out])
def test_closing_reports_a_transfer_not_returned(hangs: int, usb: Usb) -> None:
    usb.blocked = usb.stubborn = True
    usb.write(*PULL)
    usb._done(AT.transfer_in if hangs == AT.transfer_out else AT.transfer_out, CANCELLED)
    usb.waits.clear()
    assert usb.block.call(exchange.cancel_transfers) == 0 and usb.cancelled == [hangs]
    assert usb.waits == [2000]
    usb.stubborn = False
    assert usb.block.call(exchange.cancel_transfers) == 1
