"""One tick with a Falcon, in nopython mode: read replies and send one packet with libusb's asynchronous calls.

The C functions, whose memory `block` lays out, call the libusb that pyusb has loaded, on the handle that pyusb has
opened, by the addresses of its functions: without interpreter lock, and without an allocation here.

One transfer in each direction exists as long as the device is open. The one from the device is always submitted; the
chip completes it with a reply, or with only its two status bytes. The packet of one tick is answered in the next,
without waiting. While an answer is missing, the tick repeats the last sample. Up to `UNANSWERED_MAX` packets may be
unanswered, so that a late reply delays one tick instead of stopping the loop; if the last of them remains unanswered
for 5 ms, the driver expects no answer to any. After `kick_s` without a reply it sends no force, because a force
computed for an old position may push the knob in the wrong direction, and sends a zero every `kick_s`; after
`timeout_s` it reports a failure.

WITHHELD reports that zero replaced the force, so that the guard fades the force in again. HELD reports that a packet
was not sent, because the motors keep the force of the previous one.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

from numba import types

from softfinger.drivers.base import HELD, LOST, OK, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.block import try_lock, unlock
from softfinger.drivers.falcon import packets
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.conversion import compute_command, convert_reply, process_byte
from softfinger.drivers.samples import (
    CURRENT_WAIT_MAX_NS,
    PAUSE_MIN_NS,
    copy_sample,
    is_finite,
    is_zero,
    shift_sample_time,
)
from softfinger.drivers.system.libc import IO_SIGNATURE, read_monotonic_ns
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.foreign import call_int32
from softfinger.proxy.kernels.jit.memory import float64_at, int32_at, int64_at, uint8_at

UNANSWERED_MAX: Final = 2
"""Maximum number of unanswered packets: one in the device, one in transmission."""
TRANSFERS_MAX: Final = 8
"""Maximum number of transfers per tick: a device that floods cannot block the loop."""
MISSING_NS: Final = 5_000_000
"""Time after which a missing answer is considered lost, like one with a wrong byte."""
WAIT_US: Final = 2000
"""Duration of one wait for a current reply."""
STOP_HANG_NS: Final = 20_000_000
"""Time after which a stop cancels a packet in progress, ten times that of a reply.

Not the rig's `timeout_s`: that may be longer than a stop waits, and the packet would be delivered after it.
"""

# Indices into struct libusb_transfer: as int64 for the user data, as int32 for status and length.
_USER_DATA, _STATUS, _ACTUAL = 5, 4, 6
_COMPLETED, _TIMED_OUT, _CANCELLED, _NO_DEVICE = 0, 2, 3, 5
_ERROR_NO_DEVICE, _ERROR_INTERRUPTED = -4, -10


@c_function(types.void(types.int64))
def on_complete(transfer: int) -> None:
    """Set the int64 that the transfer's user data points to; libusb calls it for both transfers."""
    int64_at(int64_at(transfer)[_USER_DATA])[0] = 1


@jit
def _read_clock(handle: int) -> int:
    return read_monotonic_ns(handle + 8 * AT.timespec)


@jit
def _process_events(handle: int, wait_us: int) -> int:
    """Let libusb process completed transfers, waiting up to `wait_us`; return OK or libusb's error, below 0."""
    word = int64_at(handle)
    word[AT.timespec], word[AT.timespec + 1] = 0, wait_us
    code = call_int32(word[AT.handle_events], (word[AT.context], int64_at(handle + 8 * AT.timespec), int64_at(0)))
    # A signal in this thread: nothing was processed, and there is no error.
    return OK if code == _ERROR_INTERRUPTED else int(code)


@jit
def _store_error(handle: int, error: int) -> int:
    int64_at(handle)[AT.error] = error
    return LOST


@jit
def _submit(handle: int, transfer: int, done_word: int) -> int:
    word = int64_at(handle)
    word[done_word] = 0
    code = call_int32(word[AT.submit], (word[transfer],))
    if code < 0:
        word[done_word] = 1  # not submitted
        return _store_error(handle, int(code))
    return OK


@jit
def _transfer_status(handle: int, transfer: int) -> int:
    """Return OK if the transfer was completed or cancelled, else LOST."""
    status = int32_at(int64_at(handle)[transfer])[_STATUS]
    if status in (_COMPLETED, _TIMED_OUT, _CANCELLED):
        return OK
    # An error of the bus, a stalled endpoint and an unplugged device are treated alike: check the cable.
    return _store_error(handle, _ERROR_NO_DEVICE if status == _NO_DEVICE else int(status))


@jit
def _read_transfers(handle: int, wait_us: int) -> int:
    """Read completed transfers; return the number of replies, or a status below 0."""
    word = int64_at(handle)
    count = 0
    for attempt in range(TRANSFERS_MAX):
        code = _process_events(handle, wait_us if attempt == 0 else 0)
        if code < 0:
            return _store_error(handle, code)
        if word[AT.in_done] == 0:
            break
        status = _transfer_status(handle, AT.transfer_in)
        if status != OK:
            return status
        data = uint8_at(handle + 8 * AT.buffer_in)
        for k in range(packets.STATUS_BYTES, min(int32_at(word[AT.transfer_in])[_ACTUAL], packets.CHIP_BYTES)):
            if process_byte(handle, data[k]):
                count += 1
        status = _submit(handle, AT.transfer_in, AT.in_done)
        if status != OK:
            return status
    if count > 1:
        word[AT.passed] += count - 1
    return count


@jit
def _send(handle: int, motors: packets.Counts) -> int:
    """Send a packet; return OK, HELD if the previous one is not sent yet, or a status below 0."""
    word = int64_at(handle)
    if word[AT.out_done] == 0:
        _process_events(handle, 0)
        if word[AT.out_done] == 0:
            return TIMEOUT if _read_clock(handle) - word[AT.sent_at] > word[AT.timeout_after] else HELD
    status = _transfer_status(handle, AT.transfer_out)
    return _submit_packet(handle, motors) if status == OK else status


@jit
def _submit_packet(handle: int, motors: packets.Counts) -> int:
    """Submit a packet, regardless of the result of the previous one, which must have ended; return OK or LOST."""
    word = int64_at(handle)
    packets.encode(motors, word[AT.lights], uint8_at(handle + 8 * AT.buffer_out))
    status = _submit(handle, AT.transfer_out, AT.out_done)
    if status == OK:
        word[AT.written] += 1
        word[AT.unanswered] += 1
        word[AT.has_force] = motors[0] != 0 or motors[1] != 0 or motors[2] != 0
        word[AT.sent_at] = _read_clock(handle)
    return status


@jit
def _await(handle: int) -> int:
    """Discard received replies and wait for a current one; return the number of replies, or a status below 0.

    The wait is short if there is a sample to repeat.
    """
    word = int64_at(handle)
    count = _read_transfers(handle, 0)
    # The chip stores a reply until it is polled; during a pause of the loop it was polled only once.
    word[AT.stale_replies] += word[AT.unanswered]
    start = _read_clock(handle)
    word[AT.unanswered] = 0
    is_running = word[AT.has_sample] != 0
    zero_sent_at = start - word[AT.kick]
    has_sent_zero = False
    while count >= 0:
        now = _read_clock(handle)
        if is_running and now - start > CURRENT_WAIT_MAX_NS:
            return 0
        if not is_running and now - start > word[AT.timeout_after]:
            return TIMEOUT
        if now - zero_sent_at >= word[AT.kick]:
            status = _send_own_zero(handle)
            if status < 0:
                return status
            if has_sent_zero:  # the outstanding replies are lost
                word[AT.stale_replies] = 0
            zero_sent_at, has_sent_zero = now, True
        count = _count_current(handle, _read_transfers(handle, WAIT_US))
        if count > 0:
            break
    return count


@jit
def _count_current(handle: int, count: int) -> int:
    """Return how many of `count` replies answer packets sent after the last pause, or a status below 0 unchanged."""
    word = int64_at(handle)
    stale_replies: int = max(0, min(count, word[AT.stale_replies]))
    word[AT.stale_replies] -= stale_replies
    return count - stale_replies


@jit
def _kick(handle: int) -> int:
    """Send a zero during a silence; answers missing until now are considered lost."""
    word = int64_at(handle)
    word[AT.unanswered] = word[AT.stale_replies] = 0
    word[AT.kicks] += 1
    return _send_own_zero(handle)


@jit
def _send_own_zero(handle: int) -> int:
    """Send a zero that the loop did not command.

    The next read returns WITHHELD, because otherwise a reply would restore the force at once.
    """
    word = int64_at(handle)
    status = _send(handle, (0, 0, 0))
    if status == OK and word[AT.has_sample] != 0:
        word[AT.sent_own_zero] = 1
    return status


@jit
def _read_locked(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[AT.open] == 0:
        return LOST
    now = _read_clock(handle)
    was_paused = now - word[AT.read_at] > PAUSE_MIN_NS or word[AT.has_sample] == 0
    if was_paused:
        word[AT.sampled_at] = shift_sample_time(word[AT.sampled_at], word[AT.read_at], now, word[AT.kick])
    count = _await(handle) if was_paused else _count_current(handle, _read_transfers(handle, 0))
    word[AT.read_at] = _read_clock(handle)
    if count < 0:
        return count
    status = STALE
    if count > 0:
        word[AT.sampled_at] = word[AT.read_at]
        status = convert_reply(handle)
        if status < 0:
            return status
        word[AT.has_sample] = 1
    else:
        silence = now - word[AT.sampled_at]
        if silence > word[AT.timeout_after]:
            return TIMEOUT
        if word[AT.unanswered] >= UNANSWERED_MAX and now - word[AT.sent_at] > MISSING_NS:
            word[AT.unanswered] = 0
        if silence > word[AT.kick] and now - word[AT.sent_at] > word[AT.kick]:
            kick_status = _kick(handle)
            if kick_status < 0:
                return kick_status
    copy_sample(float64_at(handle + 8 * AT.sample), sample)
    if word[AT.sent_own_zero] != 0:
        word[AT.sent_own_zero] = 0
        return WITHHELD
    return status


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    if not try_lock(handle, AT.lock):
        copy_sample(float64_at(handle + 8 * AT.sample), sample)
        return STALE
    status = _read_locked(handle, sample)
    unlock(handle, AT.lock)
    return status


@jit
def _write_locked(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    zero = is_zero(wrench, 3)  # no motor turns the knob: torque is accepted, but not displayed
    armed = word[AT.armed] != 0 and word[AT.stopped] == 0
    if word[AT.open] == 0:
        return OK if zero else WITHHELD
    motors, is_limited = (0, 0, 0), False
    has_no_sample = word[AT.has_sample] == 0 or _read_clock(handle) - word[AT.sampled_at] > word[AT.kick]
    has_position = isfinite(float64_at(handle + 8 * AT.sample)[0])
    may_send = is_finite(wrench, 3) and armed and not has_no_sample and has_position
    sends_force = may_send and not zero
    if sends_force:
        motors, is_limited = compute_command(handle, (wrench[0], wrench[1], wrench[2]))
        if is_limited:
            word[AT.cut] += 1
    # A zero that ends a force is sent regardless of unanswered packets.
    status = HELD
    if word[AT.unanswered] < UNANSWERED_MAX or (word[AT.has_force] != 0 and not sends_force):
        status = _send(handle, motors)
    if status == HELD:
        word[AT.held] += 1
    if status < 0:
        return status
    # During a silence a zero also counts as withheld, because the hand may move anywhere. When disarmed, it does not,
    # because the loop is ending.
    if not may_send and (not zero or armed):
        return WITHHELD
    if status == HELD:
        return HELD if word[AT.has_force] != 0 or not zero else STALE  # the motors have this zero already
    return STALE if is_limited else OK


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    if not try_lock(handle, AT.lock):
        return WITHHELD
    status = _write_locked(handle, wrench)
    unlock(handle, AT.lock)
    return status


@c_function(types.int64(types.int64))
def start_reading(handle: int) -> int:
    """Submit the transfer from the device; return OK, or a status below 0."""
    return _submit(handle, AT.transfer_in, AT.in_done)


@c_function(types.int64(types.int64))
def disarm_and_zero(handle: int) -> int:
    """Disarm and send a zero; return 1 if it was sent or cannot be, 0 if the call must be repeated.

    A packet that hangs is cancelled first: if the device reconnected, a force queued in the bus would reach the motors,
    and nothing would end it.
    """
    word = int64_at(handle)
    word[AT.stopped] = 1  # first, because a concurrent `arm` may set `armed` again
    word[AT.armed] = 0
    if not try_lock(handle, AT.lock):
        return 0  # an exchange is in progress
    must_repeat = False
    if word[AT.open] != 0:
        if word[AT.out_done] == 0:
            _process_events(handle, WAIT_US)
        if word[AT.out_done] == 0:
            must_repeat = True
            if _read_clock(handle) - word[AT.sent_at] > STOP_HANG_NS:
                call_int32(word[AT.cancel], (word[AT.transfer_out],))
        elif word[AT.has_force] != 0 or int32_at(word[AT.transfer_out])[_STATUS] != _COMPLETED:
            must_repeat = _submit_packet(handle, (0, 0, 0)) == OK
    unlock(handle, AT.lock)
    return 0 if must_repeat else 1


@c_function(types.int64(types.int64))
def cancel_transfers(handle: int) -> int:
    """Cancel both transfers, after `disarm_and_zero`. Return 1 if neither is active, 0 to repeat the call."""
    word = int64_at(handle)
    if not try_lock(handle, AT.lock):
        return 0
    word[AT.open] = 0
    if word[AT.in_done] == 0:
        call_int32(word[AT.cancel], (word[AT.transfer_in],))
    if word[AT.out_done] == 0:
        call_int32(word[AT.cancel], (word[AT.transfer_out],))
    _process_events(handle, WAIT_US)
    is_done = word[AT.in_done] != 0 and word[AT.out_done] != 0
    unlock(handle, AT.lock)
    return 1 if is_done else 0
