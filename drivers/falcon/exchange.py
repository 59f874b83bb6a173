"""One tick with a Falcon, from nopython: replies taken, one packet sent, through libusb's asynchronous calls.

The C functions share a block of int64 words with Python; its address is the device's handle. They call the libusb that
pyusb has loaded, on the handle that pyusb has opened, by the addresses of its functions: no interpreter lock, and no
allocation of ours.

One transfer in and one out are there for as long as the device is open. The one in is always under way; the chip
completes it with a reply, or with its two status bytes alone. A packet of one tick is answered in the next, and nobody
waits: while an answer is missing the tick repeats the last sample, and up to `DEPTH` packets may be without one, so
that a late reply costs a tick and not the loop. After `kick_s` without a reply no force is sent, for where the knob
is now a force for where it was may push it the wrong way, and a zero is sent every `kick_s`; after `timeout_s` it is
given up.
"""

from __future__ import annotations

from math import isfinite, nan
from typing import Any, Final

from numba import types

from softfinger.drivers.base import FORCE_OFF, LOST, OK, SAMPLE_BUTTONS, SAMPLE_TIME, STALE, TIMEOUT
from softfinger.drivers.falcon import delta, packets
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.foreign import call_int32
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int32_at, int64_at, uint8_at
from softfinger.proxy.kernels.model import Vec3

_CPointer: Any = types.CPointer
IO_SIGNATURE: Final[Any] = types.int64(types.int64, _CPointer(types.float64))

# Words of the block. Counters first.
REPLIES: Final = 0  # whole packets received
PASSED: Final = 1  # of these, older ones passed over for a newer
WRITTEN: Final = 2  # packets sent
HELD: Final = 3  # forces not sent, because an answer or the bus was late
KICKS: Final = 4  # zeros sent into a silence
CUT: Final = 5  # forces that the motors could not give
GARBLED: Final = 6  # pieces of the stream that were no packet
UNREACHED: Final = 7  # encoder counts to which no place of the knob belongs
# Settings:
CONTEXT: Final = 8  # libusb's
SUBMIT: Final = 9  # addresses of libusb's functions
HANDLE_EVENTS: Final = 10
CANCEL: Final = 11
IN: Final = 12  # addresses of the transfers
OUT: Final = 13
KICK: Final = 14  # ns of silence
TIMEOUT_AFTER: Final = 15  # ns of silence
LIGHTS: Final = 16  # bits of the state byte, the homing request among them
# Shared with other threads:
OPEN: Final = 17
ARMED: Final = 18
LOCK: Final = 19  # held in every exchange
# Of the exchange:
IN_DONE: Final = 20  # set by libusb's call back; together with the next, each transfer's user data
OUT_DONE: Final = 21
AWAITED: Final = 22  # packets without an answer
PUSHES: Final = 23  # whether the last packet sent was a force
SENSED: Final = 24  # whether there is a sample to repeat
HOMED: Final = 25  # bits of the last reply
STAYS_HOMED: Final = 26  # the bits were seen without the homing request, so losing them means something
HEARD_AT: Final = 27  # ns, when the newest reply was taken
READ_AT: Final = 28  # ns, when the loop last read
SENT_AT: Final = 29  # ns
OPENED_AT: Final = 30  # ns
FILL: Final = 31  # bytes in PACKET
ERROR: Final = 32  # libusb's, at the failure
# Memory:
PACKET: Final = 33  # 16 bytes being put together
NEWEST: Final = 35  # 16 bytes of the newest reply
TIMESPEC: Final = 37  # two words, also a struct timeval
COUNTS: Final = 39  # three, of the newest reply
POSITION: Final = 42  # three float64: m, device's frame
SAMPLE: Final = 45  # nine float64, the last one
CENTRE: Final = 54  # three float64: m, device's frame
GAIN: Final = 57  # a float64: motor counts per N m
BUFFER_IN: Final = 58  # 64 bytes
BUFFER_OUT: Final = 66  # 16 bytes
WORDS: Final = 68

IN_BYTES: Final = 64
STATUS_BYTES: Final = 2
"""The serial chip's own, in front of whatever it passes on."""
DEPTH: Final = 2
"""Packets that may be without an answer: one in the device, one on its way."""
TAKEN_MAX: Final = 8
"""Transfers taken in one tick: a device that floods cannot hold the loop."""
RESUME_NS: Final = 30_000_000
"""After a pause this long the reply that waits is an old one, and a new one is asked for."""
SLICE_US: Final = 2000
"""Time of one wait for a reply, when there is none to repeat."""

# struct libusb_transfer, in words, and in int32 for its status and length
_USER_DATA, _STATUS, _ACTUAL = 5, 4, 6
_COMPLETED, _TIMED_OUT, _NO_DEVICE = 0, 2, 5
_ERROR_NO_DEVICE: Final = -4

_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, _CPointer(types.int64)))


@c_function(types.void(types.int64))
def done(transfer: int) -> None:
    """libusb's call back for both transfers: raises the word that the transfer's user data points to."""
    int64_at(int64_at(transfer)[_USER_DATA])[0] = 1


@jit
def _now(handle: int) -> int:
    timespec = int64_at(handle + 8 * TIMESPEC)
    _clock_gettime(1, timespec)
    return int(timespec[0] * 1_000_000_000 + timespec[1])


@jit
def _events(handle: int, wait_us: int) -> int:
    """Let libusb finish what is finished, waiting so long for it."""
    word = int64_at(handle)
    word[TIMESPEC], word[TIMESPEC + 1] = 0, wait_us
    return int(call_int32(word[HANDLE_EVENTS], (word[CONTEXT], int64_at(handle + 8 * TIMESPEC), int64_at(0))))


@jit
def _failed(handle: int, error: int) -> int:
    """What libusb's error of a call means."""
    int64_at(handle)[ERROR] = error
    return LOST


@jit
def _submit(handle: int, transfer: int, done_word: int) -> int:
    word = int64_at(handle)
    word[done_word] = 0
    code = call_int32(word[SUBMIT], (word[transfer],))
    if code < 0:
        word[done_word] = 1  # not under way
        return _failed(handle, int(code))
    return OK


@jit
def _ended(handle: int, transfer: int) -> int:
    """OK when the transfer has gone through, or LOST."""
    status = int32_at(int64_at(handle)[transfer])[_STATUS]
    if status in (_COMPLETED, _TIMED_OUT):
        return OK
    # An error of the bus, a stalled endpoint and a device that is gone look alike in time: the cable.
    return _failed(handle, _ERROR_NO_DEVICE if status == _NO_DEVICE else int(status))


@jit
def feed(handle: int, byte: int) -> bool:
    """Take one byte of the device's stream; whether it ends a reply, which is then in NEWEST."""
    word = int64_at(handle)
    fill, garbled = packets.assemble(byte, word[FILL], uint8_at(handle + 8 * PACKET))
    if garbled:
        word[GARBLED] += 1
    word[FILL] = fill
    if fill < packets.SIZE:
        return False
    word[FILL] = 0
    word[NEWEST], word[NEWEST + 1] = word[PACKET], word[PACKET + 1]
    word[REPLIES] += 1
    if word[AWAITED] > 0:
        word[AWAITED] -= 1
    return True


@jit
def _take(handle: int, wait_us: int) -> int:
    """Take what has come; how many replies, the newest in NEWEST, or a status below 0."""
    word = int64_at(handle)
    came = 0
    for turn in range(TAKEN_MAX):
        code = _events(handle, wait_us if turn == 0 else 0)
        if code < 0:
            return _failed(handle, code)
        if word[IN_DONE] == 0:
            break
        status = _ended(handle, IN)
        if status != OK:
            return status
        data = uint8_at(handle + 8 * BUFFER_IN)
        for k in range(STATUS_BYTES, min(int32_at(word[IN])[_ACTUAL], IN_BYTES)):
            if feed(handle, data[k]):
                came += 1
        status = _submit(handle, IN, IN_DONE)
        if status != OK:
            return status
        wait_us = 0
    if came > 1:
        word[PASSED] += came - 1
    return came


@jit
def _send(handle: int, motors: packets.Counts) -> int:
    """Send a packet; OK, STALE while the one before is not through, or a status below 0."""
    word = int64_at(handle)
    if word[OUT_DONE] == 0:
        _events(handle, 0)
        if word[OUT_DONE] == 0:
            return TIMEOUT if _now(handle) - word[SENT_AT] > word[TIMEOUT_AFTER] else STALE
    status = _ended(handle, OUT)
    if status != OK:
        return status
    packets.encode(motors, word[LIGHTS], uint8_at(handle + 8 * BUFFER_OUT))
    status = _submit(handle, OUT, OUT_DONE)
    if status == OK:
        word[WRITTEN] += 1
        word[AWAITED] += 1
        word[PUSHES] = motors[0] != 0 or motors[1] != 0 or motors[2] != 0
        word[SENT_AT] = _now(handle)
    return status


@jit
def _await(handle: int) -> int:
    """Throw away what has come and wait for a reply of now; 1, or a status below 0."""
    word = int64_at(handle)
    begun = _now(handle)
    came = _take(handle, 0)
    word[AWAITED] = 0
    asked_at = begun - word[KICK]
    while came >= 0:
        now = _now(handle)
        if now - begun > word[TIMEOUT_AFTER]:
            return TIMEOUT
        if now - asked_at >= word[KICK]:
            status = _send(handle, (0, 0, 0))
            if status < 0:
                return status
            asked_at = now
        came = _take(handle, SLICE_US)
        if came > 0:
            return 1
    return came


@jit
def _to_world(v: Vec3) -> Vec3:
    """Device's frame (right, up, out to the user) to the world's (right, away from the user, up)."""
    return (v[0], -v[2], v[1])


@jit
def _to_device(v: Vec3) -> Vec3:
    return (v[0], v[2], -v[1])


@jit
def pose(handle: int) -> int:
    """The newest reply as the sample: OK, or FORCE_OFF when the device has lost its homing.

    Counts to which no place belongs give NaN, which the guard answers with zero force.
    """
    word = int64_at(handle)
    counts, state = packets.decode(uint8_at(handle + 8 * NEWEST))
    homed = state & packets.HOMED
    word[HOMED] = homed
    if word[LIGHTS] & packets.HOMING == 0 and word[ARMED] != 0:
        if homed == packets.HOMED:
            word[STAYS_HOMED] = 1
        elif word[STAYS_HOMED] != 0:
            return FORCE_OFF
    for k in range(3):
        word[COUNTS + k] = counts[k]
    at = float64_at(handle + 8 * POSITION)
    angle = (
        delta.THETA_ZERO + delta.RAD_PER_COUNT * counts[0],
        delta.THETA_ZERO + delta.RAD_PER_COUNT * counts[1],
        delta.THETA_ZERO + delta.RAD_PER_COUNT * counts[2],
    )
    p, found = delta.forward(angle, (at[0], at[1], at[2]))
    kept = float64_at(handle + 8 * SAMPLE)
    if found:
        centre = float64_at(handle + 8 * CENTRE)
        place = _to_world(vec3.sub(p, (centre[0], centre[1], centre[2])))
    else:
        word[UNREACHED] += 1
        p, place = delta.HOME, (nan, nan, nan)
    for k in range(3):
        at[k], kept[k] = p[k], place[k]
    kept[SAMPLE_TIME] = (word[HEARD_AT] - word[OPENED_AT]) * 1e-9
    kept[SAMPLE_BUTTONS] = float(state & packets.BUTTONS)
    return OK


@jit
def _kick(handle: int) -> int:
    """A zero into the silence; answers that have not come will not."""
    word = int64_at(handle)
    word[AWAITED] = 0
    word[KICKS] += 1
    return _send(handle, (0, 0, 0))


@jit
def _read_locked(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[OPEN] == 0:
        return LOST
    now = _now(handle)
    paused = now - word[READ_AT] > RESUME_NS or word[SENSED] == 0
    came = _await(handle) if paused else _take(handle, 0)
    word[READ_AT] = _now(handle)
    if came < 0:
        return came
    status = STALE
    if came > 0:
        word[HEARD_AT] = word[READ_AT]
        status = pose(handle)
        if status < 0:
            return status
        word[SENSED] = 1
    else:
        silence = now - word[HEARD_AT]
        if silence > word[TIMEOUT_AFTER]:
            return TIMEOUT
        if silence > word[KICK] and now - word[SENT_AT] > word[KICK]:
            kicked = _kick(handle)
            if kicked < 0:
                return kicked
    kept = float64_at(handle + 8 * SAMPLE)
    for k in range(SAMPLE_BUTTONS + 1):
        sample[k] = kept[k]
    return status


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    # Never wait here: who holds the lock is stopping the device.
    if exchange_int64(handle + 8 * LOCK, 1) != 0:
        kept = float64_at(handle + 8 * SAMPLE)
        for k in range(SAMPLE_BUTTONS + 1):
            sample[k] = kept[k]
        return STALE
    status = _read_locked(handle, sample)
    exchange_int64(handle + 8 * LOCK, 0)
    return status


@jit
def motor_counts(gain: float, place: Vec3, force: Vec3) -> tuple[packets.Counts, bool]:
    """Motor counts (3,) for a force (3,) N in the device's frame with the knob at `place`, and whether it was limited.

    A count past the largest brings all three down, so that the force keeps its direction.
    """
    torque, able = delta.torques_for(place, force)
    counts = vec3.scale(gain, torque)
    most = max(abs(counts[0]), max(abs(counts[1]), abs(counts[2])))
    cut = not able
    if most > packets.COUNT_MAX:
        counts = vec3.scale(packets.COUNT_MAX / most, counts)
        cut = True
    return (int(round(counts[0])), int(round(counts[1])), int(round(counts[2]))), cut


@jit
def _write_locked(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    finite, zero = True, True
    for k in range(3):  # no motor turns the knob: torque is taken, and not displayed
        finite = finite and isfinite(wrench[k])
        zero = zero and wrench[k] == 0.0
    if word[OPEN] == 0:
        return OK if zero else STALE
    motors, cut = (0, 0, 0), False
    deaf = word[SENSED] == 0 or _now(handle) - word[HEARD_AT] > word[KICK]
    free = not zero and finite and word[ARMED] != 0 and not deaf
    if free:
        at = float64_at(handle + 8 * POSITION)
        motors, cut = motor_counts(
            float64_at(handle + 8 * GAIN)[0],
            (at[0], at[1], at[2]),
            _to_device((wrench[0], wrench[1], wrench[2])),
        )
        if cut:
            word[CUT] += 1
    # A zero that ends a force goes out whatever is on its way.
    if word[AWAITED] >= DEPTH and not (word[PUSHES] != 0 and not free):
        word[HELD] += 1
        return STALE
    status = _send(handle, motors)
    if status == STALE:
        word[HELD] += 1
    return STALE if status == OK and (cut or (not zero and not free)) else status


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    # Never wait here: who holds the lock is stopping the device, so refusing is right as well.
    if exchange_int64(handle + 8 * LOCK, 1) != 0:
        return STALE
    status = _write_locked(handle, wrench)
    exchange_int64(handle + 8 * LOCK, 0)
    return status


@c_function(types.int64(types.int64))
def begin(handle: int) -> int:
    """Put the transfer in under way; OK, or a status below 0."""
    return _submit(handle, IN, IN_DONE)


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Disarm and send a zero; 1 when it is through or cannot be, 0 when it must be tried again."""
    word = int64_at(handle)
    word[ARMED] = 0
    if exchange_int64(handle + 8 * LOCK, 1) != 0:
        return 0  # an exchange is under way
    status = OK
    if word[OPEN] != 0 and word[PUSHES] != 0:
        status = _send(handle, (0, 0, 0))
    elif word[OPEN] != 0 and word[OUT_DONE] == 0:
        _events(handle, SLICE_US)
        status = OK if word[OUT_DONE] != 0 else STALE
    again = status == STALE or (status == OK and word[OPEN] != 0 and word[OUT_DONE] == 0)
    exchange_int64(handle + 8 * LOCK, 0)
    return 0 if again else 1


@c_function(types.int64(types.int64))
def withdraw(handle: int) -> int:
    """Cancel both transfers; 1 when neither is under way any more, 0 when it must be tried again. After `silence`."""
    word = int64_at(handle)
    if exchange_int64(handle + 8 * LOCK, 1) != 0:
        return 0
    word[OPEN] = 0
    if word[IN_DONE] == 0:
        call_int32(word[CANCEL], (word[IN],))
    if word[OUT_DONE] == 0:
        call_int32(word[CANCEL], (word[OUT],))
    _events(handle, SLICE_US)
    ended = word[IN_DONE] != 0 and word[OUT_DONE] != 0
    exchange_int64(handle + 8 * LOCK, 0)
    return 1 if ended else 0
