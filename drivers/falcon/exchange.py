"""One tick with a Falcon, in nopython mode: read replies and send one packet with libusb's asynchronous calls.

The C functions, whose memory `block` lays out, call the libusb that pyusb has loaded, on the handle that pyusb has
opened, by the addresses of its functions: without interpreter lock, and without an allocation here.

One transfer in each direction exists as long as the device is open. The one from the device is always submitted; the
chip completes it with a reply, or with only its two status bytes. The packet of one tick is answered in the next,
without waiting. While an answer is missing, the tick repeats the last sample. Up to `DEPTH` packets may be unanswered,
so that a late reply delays one tick instead of stopping the loop; if the last of them remains unanswered for 5 ms, the
driver expects no answer to any. After `kick_s` without a reply it sends no force, because a force computed for an old
position may push the knob in the wrong direction, and sends a zero every `kick_s`; after `timeout_s` it reports a
failure.

WITHHELD reports that zero replaced the force, so that the guard fades the force in again. HELD reports that a packet
was not sent, because the motors keep the force of the previous one.

The file is long because it contains all of these rules, from the reply to the packet.
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
"""Status bytes of the serial chip, before the data."""
DEPTH: Final = 2
"""Maximum number of unanswered packets: one in the device, one in transmission."""
TAKEN_MAX: Final = 8
"""Maximum number of transfers per tick: a device that floods cannot block the loop."""
MISSING_NS: Final = 5_000_000
"""Time after which a missing answer is considered lost, like one with a wrong byte."""
SLICE_US: Final = 2000
"""Duration of one wait for a current reply."""

# Indices into struct libusb_transfer: as int64 for the user data, as int32 for status and length.
_USER_DATA, _STATUS, _ACTUAL = 5, 4, 6
_COMPLETED, _TIMED_OUT, _CANCELLED, _NO_DEVICE = 0, 2, 3, 5
_ERROR_NO_DEVICE, _ERROR_INTERRUPTED = -4, -10


@c_function(types.void(types.int64))
def done(transfer: int) -> None:
    """Set the int64 that the transfer's user data points to; libusb calls it for both transfers."""
    int64_at(int64_at(transfer)[_USER_DATA])[0] = 1


@jit
def _now(handle: int) -> int:
    return monotonic_ns(handle + 8 * AT.timespec)


@jit
def _events(handle: int, wait_us: int) -> int:
    """Let libusb process completed transfers, waiting up to `wait_us`; return OK or libusb's error, below 0."""
    word = int64_at(handle)
    word[AT.timespec], word[AT.timespec + 1] = 0, wait_us
    code = call_int32(word[AT.handle_events], (word[AT.context], int64_at(handle + 8 * AT.timespec), int64_at(0)))
    # A signal in this thread: nothing was processed, and there is no error.
    return OK if code == _ERROR_INTERRUPTED else int(code)


@jit
def _failed(handle: int, error: int) -> int:
    """Store libusb's error and return LOST."""
    int64_at(handle)[AT.error] = error
    return LOST


@jit
def _submit(handle: int, transfer: int, done_word: int) -> int:
    word = int64_at(handle)
    word[done_word] = 0
    code = call_int32(word[AT.submit], (word[transfer],))
    if code < 0:
        word[done_word] = 1  # not submitted
        return _failed(handle, int(code))
    return OK


@jit
def _ended(handle: int, transfer: int) -> int:
    """Return OK if the transfer was completed or cancelled, else LOST."""
    status = int32_at(int64_at(handle)[transfer])[_STATUS]
    if status in (_COMPLETED, _TIMED_OUT, _CANCELLED):
        return OK
    # An error of the bus, a stalled endpoint and an unplugged device are treated alike: check the cable.
    return _failed(handle, _ERROR_NO_DEVICE if status == _NO_DEVICE else int(status))


@jit
def _take(handle: int, wait_us: int) -> int:
    """Read completed transfers; return the number of replies, or a status below 0."""
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
    """Send a packet; return OK, HELD if the previous one is not sent yet, or a status below 0."""
    word = int64_at(handle)
    if word[AT.out_done] == 0:
        _events(handle, 0)
        if word[AT.out_done] == 0:
            return TIMEOUT if _now(handle) - word[AT.sent_at] > word[AT.timeout_after] else HELD
    status = _ended(handle, AT.transfer_out)
    return _put(handle, motors) if status == OK else status


@jit
def _put(handle: int, motors: packets.Counts) -> int:
    """Submit a packet, regardless of the result of the previous one, which must have ended; return OK or LOST."""
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
    """Discard received replies and wait for a current one; return the number of replies, or a status below 0.

    The wait is short if there is a sample to repeat.
    """
    word = int64_at(handle)
    came = _take(handle, 0)
    # The chip stores a reply until it is polled; during a pause of the loop it was polled only once.
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
            if asked:  # the outstanding replies are lost
                word[AT.older] = 0
            asked_at, asked = now, True
        came = _of_now(handle, _take(handle, SLICE_US))
        if came > 0:
            break
    return came


@jit
def _of_now(handle: int, came: int) -> int:
    """Return how many of `came` replies answer packets sent after the last pause; return a status below 0 unchanged."""
    word = int64_at(handle)
    older: int = max(0, min(came, word[AT.older]))
    word[AT.older] -= older
    return came - older


@jit
def _kick(handle: int) -> int:
    """Send a zero during a silence; answers missing until now are considered lost."""
    word = int64_at(handle)
    word[AT.awaited] = word[AT.older] = 0
    word[AT.kicks] += 1
    return _unasked_zero(handle)


@jit
def _unasked_zero(handle: int) -> int:
    """Send a zero that the loop did not command.

    The next read returns WITHHELD, because otherwise a reply would restore the force at once.
    """
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
    # Never wait here: the lock's owner is stopping the device.
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
    for k in range(3):  # no motor turns the knob: torque is accepted, but not displayed
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
    # A zero that ends a force is sent regardless of unanswered packets.
    status = HELD
    if word[AT.awaited] < DEPTH or (word[AT.pushes] != 0 and not free):
        status = _send(handle, motors)
    if status == HELD:
        word[AT.held] += 1
    if status < 0:
        return status
    # In a silence a zero also counts as withheld, because the hand may move anywhere; not when disarmed: the loop ends.
    if not able and (not zero or armed):
        return WITHHELD
    if status == HELD:
        return HELD if word[AT.pushes] != 0 or not zero else STALE  # the motors have this zero already
    return STALE if cut else OK


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    # Never wait here: the lock's owner is stopping the device, so refusing is right as well.
    if exchange_int64(handle + 8 * AT.lock, 1) != 0:
        return WITHHELD
    status = _write_locked(handle, wrench)
    exchange_int64(handle + 8 * AT.lock, 0)
    return status


@c_function(types.int64(types.int64))
def begin(handle: int) -> int:
    """Submit the transfer from the device; return OK, or a status below 0."""
    return _submit(handle, AT.transfer_in, AT.in_done)


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Disarm and send a zero; return 1 if it was sent or cannot be, 0 if the call must be repeated.

    A packet that hangs is cancelled first: if the device reconnected, a force queued in the bus would reach the motors,
    and nothing would end it.
    """
    word = int64_at(handle)
    word[AT.stopped] = 1  # first, because a concurrent `arm` may set `armed` again
    word[AT.armed] = 0
    if exchange_int64(handle + 8 * AT.lock, 1) != 0:
        return 0  # an exchange is in progress
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
    """Cancel both transfers after `silence`; return 1 if neither is active any more, 0 if the call must be repeated."""
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
