"""One tick with a serial port, from nopython: bytes read up to the newest frame, one frame written.

The C functions share a block of int64 words with Python; its address is the device's handle. They call the C library
on the port's file descriptor, without an allocation and without the interpreter lock, and a tick never waits.

The device answers each frame it is sent, one for one. So a frame goes out once the last one has been answered, or
frames would pile up in the device's buffers and forces come late; a zero after a force does not wait. Silence of
`QUIET` ends the force. A newline then wakes the device, again every `KICK`; silence of `TIMEOUT_AFTER` is the end.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final, NamedTuple

from numba import carray, types

from softfinger.drivers.base import LOST, OK, PROTOCOL, SAMPLE_BUTTONS, SAMPLE_SIZE, SAMPLE_TIME, STALE, TIMEOUT
from softfinger.drivers.libc import (
    EAGAIN,
    EINTR,
    IO_SIGNATURE,
    errno_location,
    monotonic_ns,
    poll_fd,
    read_fd,
    write_fd,
)
from softfinger.drivers.pause import RESUME_NS, RESUME_WAIT_NS, heard_at
from softfinger.drivers.serial.frames import ANGLES, FRAME_BYTES, INFO, LOOKBACK, POSITION, encode, take
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int64_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.pack import flatten, unpack
from softfinger.proxy.kernels.rotations import about_x, about_y, about_z, conjugate, multiply, normalize, rotate

# Words of the block. Counters first.
BYTES: Final = 0  # bytes received
FRAMES: Final = 1  # frames received
DRAINED: Final = 2  # of these, older ones passed over for a newer
WRITTEN: Final = 3  # frames sent
HELD: Final = 4  # frames not sent, because the last one had no answer
KICKS: Final = 5  # newlines sent into a silence
CUT: Final = 6  # forces past the largest
COUNTERS: Final = (
    "bytes",
    "frames",
    "drained",
    "written",
    "held",
    "kicks",
    "cut",
)  # names of these words, in their order
FD: Final = 7
ARMED: Final = 8
LOCK: Final = 9  # held while something is written
SENSED: Final = 10  # whether there is a sample to repeat
LOADED: Final = 11  # whether the last frame sent had a force
OPENED_AT: Final = 12  # ns
HEARD_AT: Final = 13  # ns, when the newest frame was read
READ_AT: Final = 14  # ns, when the loop last read
KICKED_AT: Final = 15  # ns
QUIET: Final = 16  # ns of silence
KICK: Final = 17  # ns
TIMEOUT_AFTER: Final = 18  # ns of silence
ASKED_AT: Final = 19  # BYTES when the last frame was sent; ANSWERED or more since then are its answer
UNDERSTOOD_AT: Final = 20  # BYTES when the newest frame was read
LEFT: Final = 21  # bytes of OUT_BUFFER that the port has not taken yet
IN_BUFFER: Final = 22  # addresses, from here on
OUT_BUFFER: Final = 23
SCRATCH: Final = 24  # (NUMBERS,) float64
VALUES: Final = 25  # (NUMBERS,) float64 of the newest frame
SAMPLE: Final = 26  # (SAMPLE_SIZE,) float64, the last one
MODEL: Final = 27  # (MODEL_SIZE,) float64
POLL: Final = 28  # struct pollfd
TIMESPEC: Final = 29  # two words
WAKE: Final = 31  # a newline
WORDS: Final = 32

CHUNK: Final = 1024
"""Bytes of one read."""
DRAIN_MAX: Final = 16
"""Reads in one tick: four times what the kernel keeps for a port; a device that floods cannot hold the loop."""
ANSWERED: Final = FRAME_BYTES
"""Bytes that are an answer, whether they can be understood or not."""
WAIT_MS: Final = 10
"""Time of one wait for a frame of now."""

_POLLIN: Final = 1 << 32  # `events` of a struct pollfd read as one little-endian word


class Model(NamedTuple):
    """What turns a frame into a pose and a force into a frame.

    position     (3,) m  device's origin in the world
    orientation  (4,)    device to world
    force_max    N
    """

    position: Vec3
    orientation: Quaternion
    force_max: float


_MODEL_LIKE: Final = Model((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0)
_MODEL_SIZE: Final = len(flatten(_MODEL_LIKE))


@jit
def _now(handle: int) -> int:
    return monotonic_ns(handle + TIMESPEC * 8)


@jit
def _drain(handle: int) -> int:
    """Read until nothing is left; how many frames came, the newest in VALUES, or a status below 0."""
    word = int64_at(handle)
    frames = 0
    for _ in range(DRAIN_MAX):
        count = read_fd(word[FD], word[IN_BUFFER] + LOOKBACK, CHUNK)
        if count < 0:
            error = errno_location()[0]
            if error == EINTR:
                continue
            if error != EAGAIN:
                return LOST
            break
        if count == 0:
            return LOST
        word[BYTES] += count
        frames += take(word[IN_BUFFER], count, float64_at(word[SCRATCH]), float64_at(word[VALUES]))
        if count < CHUNK:
            break
    if frames > 0:
        word[FRAMES] += frames
        word[DRAINED] += frames - 1
        word[UNDERSTOOD_AT] = word[BYTES]
    return frames


@jit
def _put(handle: int, address: int, count: int) -> int:
    """Write bytes; how many the port took, 0 when it is full, or a status below 0."""
    for _ in range(4):
        taken: int = write_fd(int64_at(handle)[FD], address, count)
        if taken >= 0:
            return taken
        error = errno_location()[0]
        if error == EAGAIN:
            return 0
        if error != EINTR:
            return LOST
    return 0


@jit
def _finish(handle: int) -> int:
    """Write what is left of a frame; OK when nothing is, STALE when the port is full, or a status below 0."""
    word = int64_at(handle)
    if word[LEFT] > 0:
        taken = _put(handle, word[OUT_BUFFER] + FRAME_BYTES - word[LEFT], word[LEFT])
        if taken < 0:
            return taken
        word[LEFT] -= taken
    return OK if word[LEFT] == 0 else STALE


@jit
def _send(handle: int, force: Vec3) -> int:
    """Write a force (N, device's frame); OK, STALE when the port did not take a whole frame, or a status below 0.

    A frame that went out in part is finished before anything else: the device would read a cut one as another force.
    """
    word = int64_at(handle)
    status = _finish(handle)
    if status != OK:
        return status
    encode(force, word[OUT_BUFFER])
    taken = _put(handle, word[OUT_BUFFER], FRAME_BYTES)
    if taken <= 0:
        return taken if taken < 0 else STALE
    word[LEFT] = FRAME_BYTES - taken
    word[WRITTEN] += 1
    word[LOADED] = 1 if force[0] != 0.0 or force[1] != 0.0 or force[2] != 0.0 else 0
    word[ASKED_AT] = word[BYTES]
    return _finish(handle)


@jit
def _kick(handle: int) -> int:
    """A newline, after a force a zero first; unless who stops the device is writing: then that is the kick."""
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return STALE
    word = int64_at(handle)
    status = _finish(handle)
    if status == OK and word[LOADED] != 0:
        status = _send(handle, (0.0, 0.0, 0.0))
    if status == OK:
        taken = _put(handle, handle + WAKE * 8, 1)
        status = LOST if taken < 0 else OK
        word[KICKS] += taken
    word[KICKED_AT] = _now(handle)
    exchange_int64(handle + LOCK * 8, 0)
    return status


@jit
def _await(handle: int) -> int:
    """Throw away what is queued and wait for a frame of now, kicking; how many came, or a status below 0.

    With a sample to repeat the wait is short.
    """
    word = int64_at(handle)
    status = _drain(handle)
    begun = _now(handle)
    heard = word[BYTES]
    running = word[SENSED] != 0
    word[KICKED_AT] = begun - word[KICK]
    while status >= 0:
        now = _now(handle)
        if running and now - begun > RESUME_WAIT_NS:
            return 0
        if not running and now - begun > word[TIMEOUT_AFTER]:
            return PROTOCOL if word[BYTES] - heard >= ANSWERED else TIMEOUT
        if now - word[KICKED_AT] >= word[KICK]:
            status = _kick(handle)
            if status < 0:
                return status
        word[POLL] = word[FD] | _POLLIN
        poll_fd(int64_at(handle + POLL * 8), 1, WAIT_MS)
        status = _drain(handle)
        if status > 0:
            break
    return status


@jit
def _pose(handle: int, model: Model) -> None:
    """The newest frame as the sample: R = Rz(tA) Ry(-lambda) Rx(tD) Ry(tE)."""
    word = int64_at(handle)
    values, kept = float64_at(word[VALUES]), float64_at(word[SAMPLE])
    x, y, z = 1e-3 * values[POSITION], 1e-3 * values[POSITION + 1], 1e-3 * values[POSITION + 2]
    position = vec3.add(rotate(model.orientation, (x, y, z)), model.position)
    body = multiply(about_z(values[ANGLES]), about_y(-values[ANGLES + 1]))
    wrist = multiply(about_x(values[ANGLES + 2]), about_y(values[ANGLES + 3]))
    orientation = normalize(multiply(model.orientation, multiply(body, wrist)))
    for k in range(3):
        kept[k] = position[k]
    for k in range(4):
        kept[3 + k] = orientation[k]
    kept[SAMPLE_BUTTONS] = float(int(values[INFO]) & 0xFFFF)


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[FD] < 0:
        return LOST
    now = _now(handle)
    paused = now - word[READ_AT] > RESUME_NS or word[SENSED] == 0
    if paused:
        word[HEARD_AT] = heard_at(word[HEARD_AT], word[READ_AT], now, word[QUIET])
    word[READ_AT] = now
    came = _await(handle) if paused else _drain(handle)
    if came < 0:
        return came
    kept = float64_at(word[SAMPLE])
    status = STALE
    if came > 0:
        word[HEARD_AT] = _now(handle)
        _pose(handle, unpack(_MODEL_LIKE, carray(float64_at(word[MODEL]), (_MODEL_SIZE,))))
        kept[SAMPLE_TIME] = (word[HEARD_AT] - word[OPENED_AT]) * 1e-9
        word[SENSED] = 1
        status = OK
    else:
        silence = now - word[HEARD_AT]
        if silence > word[TIMEOUT_AFTER]:
            return PROTOCOL if word[BYTES] - word[UNDERSTOOD_AT] >= ANSWERED else TIMEOUT
        if silence > word[QUIET] and now - word[KICKED_AT] >= word[KICK]:
            kicked = _kick(handle)
            if kicked < 0:
                return kicked
    if paused:
        word[READ_AT] = _now(handle)  # waiting for the device is no pause of the loop
    for k in range(SAMPLE_SIZE):
        sample[k] = kept[k]
    return status


@jit
def _command(handle: int, model: Model, wrench: Any) -> int:
    """Send a wrench; STALE too when it had to be limited."""
    word = int64_at(handle)
    force = rotate(conjugate(model.orientation), (wrench[0], wrench[1], wrench[2]))
    size = vec3.norm(force)
    if size <= model.force_max:
        return _send(handle, force)
    word[CUT] += 1
    status = _send(handle, vec3.scale(model.force_max / size, force))
    return STALE if status == OK else status


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    # Never wait here: who holds the lock is stopping the device, so refusing is right as well.
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return STALE
    finite, zero = True, True
    for k in range(3):  # no motor turns the handle: torque is taken, and not displayed
        finite = finite and isfinite(wrench[k])
        zero = zero and wrench[k] == 0.0
    deaf = _now(handle) - word[HEARD_AT] > word[QUIET] or word[SENSED] == 0
    asked = word[BYTES] - word[ASKED_AT] < ANSWERED
    status = OK
    if word[FD] < 0:
        status = OK if zero else STALE
    elif zero or not finite or not word[ARMED] or deaf:
        # Stopped, or deaf: where the arm is now, a force for where it was may push it the wrong way.
        if word[LOADED] != 0 or not (asked or deaf):
            status = _send(handle, (0.0, 0.0, 0.0))
        if status == OK and not zero:
            status = STALE
    elif asked:
        word[HELD] += 1
        status = STALE
    else:
        status = _command(handle, unpack(_MODEL_LIKE, carray(float64_at(word[MODEL]), (_MODEL_SIZE,))), wrench)
    exchange_int64(handle + LOCK * 8, 0)
    return status


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Disarm and send a zero frame; 1 when it is done, 0 when it was not taken and must be tried again."""
    word = int64_at(handle)
    word[ARMED] = 0
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return 0  # a write is under way
    status = OK
    if word[FD] >= 0:
        status = _send(handle, (0.0, 0.0, 0.0))
    exchange_int64(handle + LOCK * 8, 0)
    return 0 if status == STALE else 1
