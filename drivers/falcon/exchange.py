"""One tick with a Falcon, from nopython: replies taken, one packet sent, through libusb's asynchronous calls.

The C functions, whose memory `block` lays out, call the libusb that pyusb has loaded, on the handle that pyusb has
opened, by the addresses of its functions: no interpreter lock, and no allocation of ours.

One transfer in and one out are there for as long as the device is open. The one in is always under way; the chip
completes it with a reply, or with its two status bytes alone. A packet of one tick is answered in the next, and nobody
waits: while an answer is missing the tick repeats the last sample, and up to `DEPTH` packets may be without one, so
that a late reply costs a tick and not the loop; once the second has been without one for 5 ms, neither is waited for.
After `kick_s` without a reply no force is sent, for where the knob is now a force for where it was may push it the
wrong way, and a zero is sent every `kick_s`; after `timeout_s` it is given up.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

from numba import types

from softfinger.drivers.base import LOST, OK, SAMPLE_SIZE, STALE, TIMEOUT
from softfinger.drivers.falcon import block, packets
from softfinger.drivers.falcon.reply import command, feed, pose
from softfinger.drivers.libc import IO_SIGNATURE, monotonic_ns
from softfinger.drivers.pause import RESUME_NS, RESUME_WAIT_NS, heard_at
from softfinger.proxy.kernels.foreign import call_int32
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int32_at, int64_at, uint8_at

IN_BYTES: Final = 64
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
    return monotonic_ns(handle + 8 * block.TIMESPEC)


@jit
def _events(handle: int, wait_us: int) -> int:
    """Let libusb finish what is finished, waiting so long for it; libusb's error, below 0."""
    word = int64_at(handle)
    word[block.TIMESPEC], word[block.TIMESPEC + 1] = 0, wait_us
    code = call_int32(
        word[block.HANDLE_EVENTS], (word[block.CONTEXT], int64_at(handle + 8 * block.TIMESPEC), int64_at(0))
    )
    # A signal in this thread: nothing was finished, and nothing is wrong.
    return OK if code == _ERROR_INTERRUPTED else int(code)


@jit
def _failed(handle: int, error: int) -> int:
    """What libusb's error of a call means."""
    int64_at(handle)[block.ERROR] = error
    return LOST


@jit
def _submit(handle: int, transfer: int, done_word: int) -> int:
    word = int64_at(handle)
    word[done_word] = 0
    code = call_int32(word[block.SUBMIT], (word[transfer],))
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
        if word[block.IN_DONE] == 0:
            break
        status = _ended(handle, block.IN)
        if status != OK:
            return status
        data = uint8_at(handle + 8 * block.BUFFER_IN)
        for k in range(STATUS_BYTES, min(int32_at(word[block.IN])[_ACTUAL], IN_BYTES)):
            if feed(handle, data[k]):
                came += 1
        status = _submit(handle, block.IN, block.IN_DONE)
        if status != OK:
            return status
        wait_us = 0
    if came > 1:
        word[block.PASSED] += came - 1
    return came


@jit
def _send(handle: int, motors: packets.Counts) -> int:
    """Send a packet; OK, STALE while the one before is not through, or a status below 0."""
    word = int64_at(handle)
    if word[block.OUT_DONE] == 0:
        _events(handle, 0)
        if word[block.OUT_DONE] == 0:
            return TIMEOUT if _now(handle) - word[block.SENT_AT] > word[block.TIMEOUT_AFTER] else STALE
    status = _ended(handle, block.OUT)
    return _put(handle, motors) if status == OK else status


@jit
def _put(handle: int, motors: packets.Counts) -> int:
    """Put a packet under way, whatever became of the one before, which is not; OK, or LOST."""
    word = int64_at(handle)
    packets.encode(motors, word[block.LIGHTS], uint8_at(handle + 8 * block.BUFFER_OUT))
    status = _submit(handle, block.OUT, block.OUT_DONE)
    if status == OK:
        word[block.WRITTEN] += 1
        word[block.AWAITED] += 1
        word[block.PUSHES] = motors[0] != 0 or motors[1] != 0 or motors[2] != 0
        word[block.SENT_AT] = _now(handle)
    return status


@jit
def _await(handle: int) -> int:
    """Throw away what has come and wait for a reply of now; how many came, or a status below 0.

    With a sample to repeat the wait is short.
    """
    word = int64_at(handle)
    came = _take(handle, 0)
    # The chip keeps a reply until it is asked, and while nobody read it was asked only once.
    word[block.OLDER] += word[block.AWAITED]
    begun = _now(handle)
    word[block.AWAITED] = 0
    running = word[block.SENSED] != 0
    asked_at = begun - word[block.KICK]
    asked = False
    while came >= 0:
        now = _now(handle)
        if running and now - begun > RESUME_WAIT_NS:
            return 0
        if not running and now - begun > word[block.TIMEOUT_AFTER]:
            return TIMEOUT
        if now - asked_at >= word[block.KICK]:
            status = _send(handle, (0, 0, 0))
            if status < 0:
                return status
            if asked:  # they are lost
                word[block.OLDER] = 0
            asked_at, asked = now, True
        came = _of_now(handle, _take(handle, SLICE_US))
        if came > 0:
            break
    return came


@jit
def _of_now(handle: int, came: int) -> int:
    """Of so many replies those that answer packets of after the last pause; a status below 0 as it is."""
    word = int64_at(handle)
    older: int = max(0, min(came, word[block.OLDER]))
    word[block.OLDER] -= older
    return came - older


@jit
def _kick(handle: int) -> int:
    """A zero into the silence; answers that have not come will not."""
    word = int64_at(handle)
    word[block.AWAITED] = word[block.OLDER] = 0
    word[block.KICKS] += 1
    return _send(handle, (0, 0, 0))


@jit
def _read_locked(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[block.OPEN] == 0:
        return LOST
    now = _now(handle)
    paused = now - word[block.READ_AT] > RESUME_NS or word[block.SENSED] == 0
    if paused:
        word[block.HEARD_AT] = heard_at(word[block.HEARD_AT], word[block.READ_AT], now, word[block.KICK])
    came = _await(handle) if paused else _of_now(handle, _take(handle, 0))
    word[block.READ_AT] = _now(handle)
    if came < 0:
        return came
    status = STALE
    if came > 0:
        word[block.HEARD_AT] = word[block.READ_AT]
        status = pose(handle)
        if status < 0:
            return status
        word[block.SENSED] = 1
    else:
        silence = now - word[block.HEARD_AT]
        if silence > word[block.TIMEOUT_AFTER]:
            return TIMEOUT
        if word[block.AWAITED] >= DEPTH and now - word[block.SENT_AT] > MISSING_NS:
            word[block.AWAITED] = 0
        if silence > word[block.KICK] and now - word[block.SENT_AT] > word[block.KICK]:
            kicked = _kick(handle)
            if kicked < 0:
                return kicked
    _repeat(handle, sample)
    return status


@jit
def _repeat(handle: int, sample: Any) -> None:
    kept = float64_at(handle + 8 * block.SAMPLE)
    for k in range(SAMPLE_SIZE):
        sample[k] = kept[k]


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    # Never wait here: who holds the lock is stopping the device.
    if exchange_int64(handle + 8 * block.LOCK, 1) != 0:
        _repeat(handle, sample)
        return STALE
    status = _read_locked(handle, sample)
    exchange_int64(handle + 8 * block.LOCK, 0)
    return status


@jit
def _write_locked(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    finite, zero = True, True
    for k in range(3):  # no motor turns the knob: torque is taken, and not displayed
        finite = finite and isfinite(wrench[k])
        zero = zero and wrench[k] == 0.0
    if word[block.OPEN] == 0:
        return OK if zero else STALE
    motors, cut = (0, 0, 0), False
    deaf = word[block.SENSED] == 0 or _now(handle) - word[block.HEARD_AT] > word[block.KICK]
    placed = isfinite(float64_at(handle + 8 * block.SAMPLE)[0])
    free = not zero and finite and word[block.ARMED] != 0 and not deaf and placed
    if free:
        motors, cut = command(handle, (wrench[0], wrench[1], wrench[2]))
        if cut:
            word[block.CUT] += 1
    # A zero that ends a force goes out whatever is on its way.
    if word[block.AWAITED] >= DEPTH and not (word[block.PUSHES] != 0 and not free):
        word[block.HELD] += 1
        return STALE
    status = _send(handle, motors)
    if status == STALE:
        word[block.HELD] += 1
    return STALE if status == OK and (cut or (not zero and not free)) else status


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    # Never wait here: who holds the lock is stopping the device, so refusing is right as well.
    if exchange_int64(handle + 8 * block.LOCK, 1) != 0:
        return STALE
    status = _write_locked(handle, wrench)
    exchange_int64(handle + 8 * block.LOCK, 0)
    return status


@c_function(types.int64(types.int64))
def begin(handle: int) -> int:
    """Put the transfer in under way; OK, or a status below 0."""
    return _submit(handle, block.IN, block.IN_DONE)


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Disarm and send a zero; 1 when it is through or cannot be, 0 when it must be tried again.

    A packet that hangs is withdrawn first: a force that waits in the bus would reach the motors if the device came
    back, with nobody to end it.
    """
    word = int64_at(handle)
    word[block.ARMED] = 0
    if exchange_int64(handle + 8 * block.LOCK, 1) != 0:
        return 0  # an exchange is under way
    again = False
    if word[block.OPEN] != 0:
        if word[block.OUT_DONE] == 0:
            _events(handle, SLICE_US)
        if word[block.OUT_DONE] == 0:
            again = True
            if _now(handle) - word[block.SENT_AT] > word[block.TIMEOUT_AFTER]:
                call_int32(word[block.CANCEL], (word[block.OUT],))
        elif word[block.PUSHES] != 0 or int32_at(word[block.OUT])[_STATUS] != _COMPLETED:
            again = _put(handle, (0, 0, 0)) == OK
    exchange_int64(handle + 8 * block.LOCK, 0)
    return 0 if again else 1


@c_function(types.int64(types.int64))
def withdraw(handle: int) -> int:
    """Cancel both transfers; 1 when neither is under way any more, 0 when it must be tried again. After `silence`."""
    word = int64_at(handle)
    if exchange_int64(handle + 8 * block.LOCK, 1) != 0:
        return 0
    word[block.OPEN] = 0
    if word[block.IN_DONE] == 0:
        call_int32(word[block.CANCEL], (word[block.IN],))
    if word[block.OUT_DONE] == 0:
        call_int32(word[block.CANCEL], (word[block.OUT],))
    _events(handle, SLICE_US)
    ended = word[block.IN_DONE] != 0 and word[block.OUT_DONE] != 0
    exchange_int64(handle + 8 * block.LOCK, 0)
    return 1 if ended else 0
