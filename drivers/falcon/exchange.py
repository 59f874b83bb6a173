"""One tick with a Falcon, from nopython: replies taken, one packet sent, through libusb's asynchronous calls.

The C functions, whose memory `block` lays out, call the libusb that pyusb has loaded, on the handle that pyusb has
opened, by the addresses of its functions: no interpreter lock, and no allocation of ours.

One transfer in and one out are there for as long as the device is open. The one in is always under way; the chip
completes it with a reply, or with its two status bytes alone. A packet of one tick is answered in the next, and nobody
waits: while an answer is missing the tick repeats the last sample, and up to `DEPTH` packets may be without one, so
that a late reply costs a tick and not the loop; once the second has been without one for 5 ms, neither is waited for.
After `kick_s` without a reply no force is sent, for where the knob is now a force for where it was may push it the
wrong way, and a zero is sent every `kick_s`; after `timeout_s` it is given up.

Whatever put a zero in the place of a force is told by WITHHELD, so that the guard fades in anew; a packet that was not
sent by HELD, for the motors keep the force of the one before.

The file is long because these rules stand in one place, from the reply to the packet.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

from numba import types

from softfinger.drivers.base import HELD, LOST, OK, SAMPLE_SIZE, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.falcon import packets
from softfinger.drivers.falcon.block import AT, IN_BYTES
from softfinger.drivers.falcon.reply import command, feed, pose
from softfinger.drivers.pause import RESUME_NS, RESUME_WAIT_NS, heard_at
from softfinger.drivers.system.libc import IO_SIGNATURE, monotonic_ns
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.foreign import call_int32
from softfinger.proxy.kernels.jit.memory import exchange_int64, float64_at, int32_at, int64_at, uint8_at

STATUS_BYTES: Final = 2
"""The serial chip's own, in front of whatever it passes on."""
DEPTH: Final = 2
"""Packets that may be without an answer: one in the device, one on its way."""
TAKEN_MAX: Final = 8
"""Transfers taken in one tick: a device that floods cannot hold the loop."""
MISSING_NS: Final = 5_000_000
"""An answer that has not come for so long was lost, as one with a wrong byte is: it is not waited for any more."""
SLICE_US: Final = 2000
"""Time of one wait for a reply of now."""

# struct libusb_transfer, in words, and in int32 for its status and length
_USER_DATA, _STATUS, _ACTUAL = 5, 4, 6
_COMPLETED, _TIMED_OUT, _CANCELLED, _NO_DEVICE = 0, 2, 3, 5
_ERROR_NO_DEVICE, _ERROR_INTERRUPTED = -4, -10


@c_function(types.void(types.int64))
def done(transfer: int) -> None:
    """libusb's call back for both transfers: raises the word that the transfer's user data points to."""
    int64_at(int64_at(transfer)[_USER_DATA])[0] = 1


@jit
def _now(handle: int) -> int:
    return monotonic_ns(handle + 8 * AT.timespec)


@jit
def _events(handle: int, wait_us: int) -> int:
    """Let libusb finish what is finished, waiting so long for it; libusb's error, below 0."""
    word = int64_at(handle)
    word[AT.timespec], word[AT.timespec + 1] = 0, wait_us
    code = call_int32(word[AT.handle_events], (word[AT.context], int64_at(handle + 8 * AT.timespec), int64_at(0)))
    # A signal in this thread: nothing was finished, and nothing is wrong.
    return OK if code == _ERROR_INTERRUPTED else int(code)


@jit
def _failed(handle: int, error: int) -> int:
    """What libusb's error of a call means."""
    int64_at(handle)[AT.error] = error
    return LOST


@jit
def _submit(handle: int, transfer: int, done_word: int) -> int:
    word = int64_at(handle)
    word[done_word] = 0
    code = call_int32(word[AT.submit], (word[transfer],))
    if code < 0:
        word[done_word] = 1  # not under way
        return _failed(handle, int(code))
    return OK


@jit
def _ended(handle: int, transfer: int) -> int:
    """OK when the transfer has gone through or was withdrawn, or LOST."""
    status = int32_at(int64_at(handle)[transfer])[_STATUS]
    if status in (_COMPLETED, _TIMED_OUT, _CANCELLED):
        return OK
    # An error of the bus, a stalled endpoint and a device that is gone look alike in time: the cable.
    return _failed(handle, _ERROR_NO_DEVICE if status == _NO_DEVICE else int(status))


@jit
def _take(handle: int, wait_us: int) -> int:
    """Take what has come; how many replies, the newest in NEWEST, or a status below 0."""
    word = int64_at(handle)
    came = 0
    for turn in range(TAKEN_MAX):
        code = _events(handle, wait_us if turn == 0 else 0)
        if code < 0:
            return _failed(handle, code)
        if word[AT.in_done] == 0:
            break
        status = _ended(handle, AT.transfer_in)
        if status != OK:
            return status
        data = uint8_at(handle + 8 * AT.buffer_in)
        for k in range(STATUS_BYTES, min(int32_at(word[AT.transfer_in])[_ACTUAL], IN_BYTES)):
            if feed(handle, data[k]):
                came += 1
        status = _submit(handle, AT.transfer_in, AT.in_done)
        if status != OK:
            return status
    if came > 1:
        word[AT.passed] += came - 1
    return came


@jit
def _send(handle: int, motors: packets.Counts) -> int:
    """Send a packet; OK, HELD while the one before is not through, or a status below 0."""
    word = int64_at(handle)
    if word[AT.out_done] == 0:
        _events(handle, 0)
        if word[AT.out_done] == 0:
            return TIMEOUT if _now(handle) - word[AT.sent_at] > word[AT.timeout_after] else HELD
    status = _ended(handle, AT.transfer_out)
    return _put(handle, motors) if status == OK else status


@jit
def _put(handle: int, motors: packets.Counts) -> int:
    """Put a packet under way, whatever became of the one before, which is not; OK, or LOST."""
    word = int64_at(handle)
    packets.encode(motors, word[AT.lights], uint8_at(handle + 8 * AT.buffer_out))
    status = _submit(handle, AT.transfer_out, AT.out_done)
    if status == OK:
        word[AT.written] += 1
        word[AT.awaited] += 1
        word[AT.pushes] = motors[0] != 0 or motors[1] != 0 or motors[2] != 0
        word[AT.sent_at] = _now(handle)
    return status


@jit
def _await(handle: int) -> int:
    """Throw away what has come and wait for a reply of now; how many came, or a status below 0.

    With a sample to repeat the wait is short.
    """
    word = int64_at(handle)
    came = _take(handle, 0)
    # The chip keeps a reply until it is asked, and while nobody read it was asked only once.
    word[AT.older] += word[AT.awaited]
    begun = _now(handle)
    word[AT.awaited] = 0
    running = word[AT.sensed] != 0
    asked_at = begun - word[AT.kick]
    asked = False
    while came >= 0:
        now = _now(handle)
        if running and now - begun > RESUME_WAIT_NS:
            return 0
        if not running and now - begun > word[AT.timeout_after]:
            return TIMEOUT
        if now - asked_at >= word[AT.kick]:
            status = _unasked_zero(handle)
            if status < 0:
                return status
            if asked:  # they are lost
                word[AT.older] = 0
            asked_at, asked = now, True
        came = _of_now(handle, _take(handle, SLICE_US))
        if came > 0:
            break
    return came


@jit
def _of_now(handle: int, came: int) -> int:
    """Of so many replies those that answer packets of after the last pause; a status below 0 as it is."""
    word = int64_at(handle)
    older: int = max(0, min(came, word[AT.older]))
    word[AT.older] -= older
    return came - older


@jit
def _kick(handle: int) -> int:
    """A zero into the silence; answers that have not come will not."""
    word = int64_at(handle)
    word[AT.awaited] = word[AT.older] = 0
    word[AT.kicks] += 1
    return _unasked_zero(handle)


@jit
def _unasked_zero(handle: int) -> int:
    """Send a zero of the driver's own; the read that does says WITHHELD, or a reply would bring the force back at
    once."""
    word = int64_at(handle)
    status = _send(handle, (0, 0, 0))
    if status == OK and word[AT.sensed] != 0:
        word[AT.zeroed] = 1
    return status


@jit
def _read_locked(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[AT.open] == 0:
        return LOST
    now = _now(handle)
    paused = now - word[AT.read_at] > RESUME_NS or word[AT.sensed] == 0
    if paused:
        word[AT.heard_at] = heard_at(word[AT.heard_at], word[AT.read_at], now, word[AT.kick])
    came = _await(handle) if paused else _of_now(handle, _take(handle, 0))
    word[AT.read_at] = _now(handle)
    if came < 0:
        return came
    status = STALE
    if came > 0:
        word[AT.heard_at] = word[AT.read_at]
        status = pose(handle)
        if status < 0:
            return status
        word[AT.sensed] = 1
    else:
        silence = now - word[AT.heard_at]
        if silence > word[AT.timeout_after]:
            return TIMEOUT
        if word[AT.awaited] >= DEPTH and now - word[AT.sent_at] > MISSING_NS:
            word[AT.awaited] = 0
        if silence > word[AT.kick] and now - word[AT.sent_at] > word[AT.kick]:
            kicked = _kick(handle)
            if kicked < 0:
                return kicked
    _repeat(handle, sample)
    if word[AT.zeroed] != 0:
        word[AT.zeroed] = 0
        return WITHHELD
    return status


@jit
def _repeat(handle: int, sample: Any) -> None:
    kept = float64_at(handle + 8 * AT.sample)
    for k in range(SAMPLE_SIZE):
        sample[k] = kept[k]


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    # Never wait here: who holds the lock is stopping the device.
    if exchange_int64(handle + 8 * AT.lock, 1) != 0:
        _repeat(handle, sample)
        return STALE
    status = _read_locked(handle, sample)
    exchange_int64(handle + 8 * AT.lock, 0)
    return status


@jit
def _write_locked(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    finite, zero = True, True
    for k in range(3):  # no motor turns the knob: torque is taken, and not displayed
        finite = finite and isfinite(wrench[k])
        zero = zero and wrench[k] == 0.0
    armed = word[AT.armed] != 0 and word[AT.stopped] == 0
    if word[AT.open] == 0:
        return OK if zero else WITHHELD
    motors, cut = (0, 0, 0), False
    deaf = word[AT.sensed] == 0 or _now(handle) - word[AT.heard_at] > word[AT.kick]
    placed = isfinite(float64_at(handle + 8 * AT.sample)[0])
    able = finite and armed and not deaf and placed
    free = able and not zero
    if free:
        motors, cut = command(handle, (wrench[0], wrench[1], wrench[2]))
        if cut:
            word[AT.cut] += 1
    # A zero that ends a force goes out whatever is on its way.
    status = HELD
    if word[AT.awaited] < DEPTH or (word[AT.pushes] != 0 and not free):
        status = _send(handle, motors)
    if status == HELD:
        word[AT.held] += 1
    if status < 0:
        return status
    # In a silence a zero is no less withheld: the hand may be anywhere when it is over. An unarmed loop ends.
    if not able and (not zero or armed):
        return WITHHELD
    if status == HELD:
        return HELD if word[AT.pushes] != 0 or not zero else STALE  # a zero that the motors have already
    return STALE if cut else OK


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    # Never wait here: who holds the lock is stopping the device, so refusing is right as well.
    if exchange_int64(handle + 8 * AT.lock, 1) != 0:
        return WITHHELD
    status = _write_locked(handle, wrench)
    exchange_int64(handle + 8 * AT.lock, 0)
    return status


@c_function(types.int64(types.int64))
def begin(handle: int) -> int:
    """Put the transfer in under way; OK, or a status below 0."""
    return _submit(handle, AT.transfer_in, AT.in_done)


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Disarm and send a zero; 1 when it is through or cannot be, 0 when it must be tried again.

    A packet that hangs is withdrawn first: a force that waits in the bus would reach the motors if the device came
    back, with nobody to end it.
    """
    word = int64_at(handle)
    word[AT.stopped] = 1  # first: an `arm` beside this one may set the other again
    word[AT.armed] = 0
    if exchange_int64(handle + 8 * AT.lock, 1) != 0:
        return 0  # an exchange is under way
    again = False
    if word[AT.open] != 0:
        if word[AT.out_done] == 0:
            _events(handle, SLICE_US)
        if word[AT.out_done] == 0:
            again = True
            if _now(handle) - word[AT.sent_at] > word[AT.timeout_after]:
                call_int32(word[AT.cancel], (word[AT.transfer_out],))
        elif word[AT.pushes] != 0 or int32_at(word[AT.transfer_out])[_STATUS] != _COMPLETED:
            again = _put(handle, (0, 0, 0)) == OK
    exchange_int64(handle + 8 * AT.lock, 0)
    return 0 if again else 1


@c_function(types.int64(types.int64))
def withdraw(handle: int) -> int:
    """Cancel both transfers; 1 when neither is under way any more, 0 when it must be tried again. After `silence`."""
    word = int64_at(handle)
    if exchange_int64(handle + 8 * AT.lock, 1) != 0:
        return 0
    word[AT.open] = 0
    if word[AT.in_done] == 0:
        call_int32(word[AT.cancel], (word[AT.transfer_in],))
    if word[AT.out_done] == 0:
        call_int32(word[AT.cancel], (word[AT.transfer_out],))
    _events(handle, SLICE_US)
    ended = word[AT.in_done] != 0 and word[AT.out_done] != 0
    exchange_int64(handle + 8 * AT.lock, 0)
    return 1 if ended else 0
