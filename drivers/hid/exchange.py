"""One tick with a hidraw node, from nopython: reports drained to the newest, one report written.

The node may be the socket of `pump`, which behaves as one.

The C functions share a block of int64 words with Python; its address is the device's handle. They call the C library
on the node's file descriptor, without an allocation and without the interpreter lock.

A device of this family answers each report it is sent, so the answer to the report of one tick is read in the next,
and nobody waits. Silence of `kick_s` is answered with a zero report every `kick_s`, which wakes such a device, and no
force is sent while it lasts; silence of `timeout_s` is the end.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final, NamedTuple

from numba import carray, types

from softfinger.drivers.base import (
    LOST,
    OK,
    PROTOCOL,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_SIZE,
    SAMPLE_TIME,
    STALE,
    TIMEOUT,
)
from softfinger.drivers.hid.chain import Chain, angles_of, currents_for, forward, orientation_of
from softfinger.drivers.hid.reports import (
    BUTTONS,
    COMMANDED_SIZE,
    CONSTANT,
    COUNTS,
    CURRENT,
    FORCE,
    GRIPPER,
    POSITION,
    QUATERNION,
    WRIST,
    decode,
    encode,
)
from softfinger.drivers.libc import (
    EAGAIN,
    EINTR,
    ETIMEDOUT,
    IO_SIGNATURE,
    errno_location,
    monotonic_ns,
    poll_fd,
    read_fd,
    write_fd,
)
from softfinger.drivers.pause import RESUME_NS, RESUME_WAIT_NS, heard_at
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.pack import flatten, unpack
from softfinger.proxy.kernels.rotations import conjugate, multiply, normalize, rotate

# Words of the block. Counters first.
REPORTS: Final = 0  # reports received
DRAINED: Final = 1  # of these, older ones passed over for a newer
WRITTEN: Final = 2  # reports sent, kicks included
KICKS: Final = 3  # zero reports sent into a silence
CUT: Final = 4  # wrenches that the motors could not give
FOREIGN: Final = 5  # reports of another id, passed over
COUNTERS: Final = ("reports", "drained", "written", "kicks", "cut", "foreign")  # names of these words, in their order
FD: Final = 6
ARMED: Final = 7
LOCK: Final = 8  # held while a report is written
SENSED: Final = 9  # whether there is a sample to repeat
OPENED_AT: Final = 10  # ns
HEARD_AT: Final = 11  # ns, when the newest report was read
READ_AT: Final = 12  # ns, when the loop last read
KICKED_AT: Final = 13  # ns
KICK: Final = 14  # ns of silence
TIMEOUT_AFTER: Final = 15  # ns of silence
KIND: Final = 16
IN_ID: Final = 17
IN_BYTES: Final = 18  # with the id, if there is one
OUT_BYTES: Final = 19  # with the id, which is always there
IN_ROWS: Final = 20
OUT_ROWS: Final = 21
IN_TABLE: Final = 22  # addresses, from here on
OUT_TABLE: Final = 23
IN_BUFFER: Final = 24
NEWEST: Final = 25
OUT_BUFFER: Final = 26
VALUES: Final = 27  # (SENSED_SIZE,) float64 of the newest report
COMMAND: Final = 28  # (COMMANDED_SIZE,) float64
SAMPLE: Final = 29  # (SAMPLE_SIZE,) float64, the last one
MODEL: Final = 30  # (MODEL_SIZE,) float64
POLL: Final = 31  # struct pollfd
TIMESPEC: Final = 32  # two words
SCRATCH: Final = 34
WORDS: Final = 35

CARTESIAN: Final = 0
CARTESIAN_WITH_ORIENTATION: Final = 1
CHAIN: Final = 2
CHAIN_WITH_WRIST: Final = 3

DRAIN_MAX: Final = 256
"""Reads in one tick: four times what the kernel keeps for a node; a device that floods cannot hold the loop."""
WAIT_MS: Final = 10
"""Time of one wait for a report of now."""
IN_SPARE: Final = 1
"""A buffer is so much longer than its report: a longer one than described is then seen to be longer."""

_POLLIN: Final = 1 << 32  # `events` of a struct pollfd read as one little-endian word


class Model(NamedTuple):
    """What turns a report into a pose and a force into a report.

    chain        the arm; without meaning for a cartesian device
    position     (3,) m  device's origin in the world
    orientation  (4,)    device to world
    force_max    N       a cartesian device's; a chain is limited by its currents
    """

    chain: Chain
    position: Vec3
    orientation: Quaternion
    force_max: float


_ZERO: Final = (0.0, 0.0, 0.0)
NO_CHAIN: Final = Chain(_ZERO, _ZERO, _ZERO, _ZERO, _ZERO, 0.0, _ZERO)
_MODEL_LIKE: Final = Model(NO_CHAIN, _ZERO, (1.0, 0.0, 0.0, 0.0), 0.0)
_MODEL_SIZE: Final = len(flatten(_MODEL_LIKE))


@jit
def _now(handle: int) -> int:
    return monotonic_ns(handle + TIMESPEC * 8)


@jit
def _drain(handle: int) -> int:
    """Read until nothing is left; how many reports came, the newest in NEWEST, or a status below 0."""
    word = int64_at(handle)
    came, size = 0, word[IN_BYTES]
    for _ in range(DRAIN_MAX):
        count = read_fd(word[FD], word[IN_BUFFER], size + IN_SPARE)
        if count < 0:
            error = errno_location()[0]
            if error == EINTR:
                continue
            if error != EAGAIN:
                return LOST
            break
        if count == 0:
            return LOST
        if word[IN_ID] != 0 and uint8_at(word[IN_BUFFER])[0] != word[IN_ID]:
            word[FOREIGN] += 1
            continue
        if count != size:
            return PROTOCOL
        if came > 0:
            word[DRAINED] += 1
        came += 1
        word[REPORTS] += 1
        spare = word[NEWEST]
        word[NEWEST] = word[IN_BUFFER]
        word[IN_BUFFER] = spare
    return came


@jit
def _send(handle: int) -> int:
    """Write OUT_BUFFER; OK, STALE when the device took nothing just now, or a status below 0."""
    word = int64_at(handle)
    for _ in range(4):
        count = write_fd(word[FD], word[OUT_BUFFER], word[OUT_BYTES])
        if count == word[OUT_BYTES]:
            word[WRITTEN] += 1
            return OK
        if count >= 0:
            return PROTOCOL
        error = errno_location()[0]
        if error == ETIMEDOUT:
            return TIMEOUT
        if error == EAGAIN:
            return STALE
        if error != EINTR:
            return LOST
    return STALE


@jit
def _clear(handle: int) -> None:
    word = int64_at(handle)
    command = float64_at(word[COMMAND])
    for k in range(COMMANDED_SIZE):
        command[k] = 0.0
    command[CONSTANT] = 1.0


@jit
def _encode(handle: int) -> bool:
    word = int64_at(handle)
    # The report id stands before the data, 0 where reports have none.
    return encode(
        float64_at(word[COMMAND]), word[OUT_TABLE], word[OUT_ROWS], handle + SCRATCH * 8, word[OUT_BUFFER] + 1
    )


@jit
def _send_zero(handle: int) -> int:
    _clear(handle)
    _encode(handle)
    return _send(handle)


@jit
def _kick(handle: int) -> int:
    """A zero report, unless one is being written by who stops the device: then that one is the kick."""
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return STALE
    status = _send_zero(handle)
    exchange_int64(handle + LOCK * 8, 0)
    word = int64_at(handle)
    word[KICKS] += 1
    word[KICKED_AT] = _now(handle)
    return status


@jit
def _await(handle: int) -> int:
    """Throw away what is queued and wait for a report of now, kicking; how many came, or a status below 0.

    With a sample to repeat the wait is short.
    """
    word = int64_at(handle)
    status = _drain(handle)
    begun = _now(handle)
    running = word[SENSED] != 0
    while status >= 0:
        status = _kick(handle)
        if status < 0:
            return status
        word[POLL] = word[FD] | _POLLIN
        poll_fd(int64_at(handle + POLL * 8), 1, WAIT_MS)
        status = _drain(handle)
        if status > 0:
            break
        waited = _now(handle) - begun
        if status == 0 and running and waited > RESUME_WAIT_NS:
            return 0
        if status == 0 and not running and waited > word[TIMEOUT_AFTER]:
            return TIMEOUT
    return status


@jit
def _pose(handle: int, model: Model) -> bool:
    """The newest report as the sample; False where it holds no pose."""
    word = int64_at(handle)
    values, kept = float64_at(word[VALUES]), float64_at(word[SAMPLE])
    at = word[NEWEST] + (1 if word[IN_ID] != 0 else 0)
    if not decode(at, word[IN_TABLE], word[IN_ROWS], handle + SCRATCH * 8, values):
        return False
    kind, orientation = word[KIND], (1.0, 0.0, 0.0, 0.0)
    if kind in (CHAIN, CHAIN_WITH_WRIST):
        angles = angles_of(model.chain, (values[COUNTS], values[COUNTS + 1], values[COUNTS + 2]))
        position = forward(model.chain, angles)
        if kind == CHAIN_WITH_WRIST:
            wrist = (values[WRIST], values[WRIST + 1], values[WRIST + 2])
            orientation = normalize(multiply(model.orientation, orientation_of(model.chain, angles, wrist)))
    else:
        position = (values[POSITION], values[POSITION + 1], values[POSITION + 2])
        if kind == CARTESIAN_WITH_ORIENTATION:
            q = (values[QUATERNION], values[QUATERNION + 1], values[QUATERNION + 2], values[QUATERNION + 3])
            # normalised in two steps: the square of a number that a float32 can hold fits a float64
            size = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
            if not size > 0.0:
                return False
            orientation = normalize(multiply(model.orientation, normalize(q)))
    position = vec3.add(rotate(model.orientation, position), model.position)
    for k in range(3):
        kept[k] = position[k]
    for k in range(4):
        kept[3 + k] = orientation[k]
    kept[SAMPLE_BUTTONS] = values[BUTTONS]
    kept[SAMPLE_GRIPPER] = values[GRIPPER]
    usable = isfinite(kept[SAMPLE_BUTTONS]) and isfinite(kept[SAMPLE_GRIPPER])
    for k in range(7):
        usable = usable and isfinite(kept[k])
    return usable


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[FD] < 0:
        return LOST
    now = _now(handle)
    paused = now - word[READ_AT] > RESUME_NS or word[SENSED] == 0
    if paused:
        word[HEARD_AT] = heard_at(word[HEARD_AT], word[READ_AT], now, word[KICK])
    word[READ_AT] = now
    came = _await(handle) if paused else _drain(handle)
    if came < 0:
        return came
    status = STALE
    if came > 0:
        word[HEARD_AT] = _now(handle)
        if not _pose(handle, unpack(_MODEL_LIKE, carray(float64_at(word[MODEL]), (_MODEL_SIZE,)))):
            return PROTOCOL
        word[SENSED] = 1
        float64_at(word[SAMPLE])[SAMPLE_TIME] = (word[HEARD_AT] - word[OPENED_AT]) * 1e-9
        status = OK
    else:
        silence = now - word[HEARD_AT]
        if silence > word[TIMEOUT_AFTER]:
            return TIMEOUT
        if silence > word[KICK] and now - word[KICKED_AT] > word[KICK]:
            kicked = _kick(handle)
            if kicked < 0:
                return kicked
    if paused:
        word[READ_AT] = _now(handle)  # waiting for the device is no pause of the loop
    kept = float64_at(word[SAMPLE])
    for k in range(SAMPLE_SIZE):
        sample[k] = kept[k]
    return status


@jit
def _command(handle: int, model: Model, wrench: Any) -> bool:
    """Put a wrench into the report; whether it had to be limited."""
    word = int64_at(handle)
    _clear(handle)
    command = float64_at(word[COMMAND])
    values = float64_at(word[VALUES])
    force = rotate(conjugate(model.orientation), (wrench[0], wrench[1], wrench[2]))
    if word[KIND] in (CHAIN, CHAIN_WITH_WRIST):
        angles = angles_of(model.chain, (values[COUNTS], values[COUNTS + 1], values[COUNTS + 2]))
        current, cut = currents_for(model.chain, angles, force)
        for k in range(3):
            command[CURRENT + k] = current[k]
    else:
        size = vec3.norm(force)
        cut = size > model.force_max
        if cut:
            force = vec3.scale(model.force_max / size, force)
        for k in range(3):
            command[FORCE + k] = force[k]
    return _encode(handle) or cut


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
    if word[FD] < 0:
        status = OK if zero else STALE
    elif zero or not finite or not word[ARMED] or _now(handle) - word[HEARD_AT] > word[KICK] or word[SENSED] == 0:
        # Stopped, or deaf: where the arm is now, a force for where it was may push it the wrong way.
        status = _send_zero(handle)
        if status == OK and not zero:
            status = STALE
    else:
        cut = _command(handle, unpack(_MODEL_LIKE, carray(float64_at(word[MODEL]), (_MODEL_SIZE,))), wrench)
        status = _send(handle)
        if cut:
            word[CUT] += 1
            if status == OK:
                status = STALE
    exchange_int64(handle + LOCK * 8, 0)
    return status


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Disarm and send a zero report; 1 when it is done, 0 when it was not taken and must be tried again."""
    word = int64_at(handle)
    word[ARMED] = 0
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return 0  # a write is under way
    status = OK
    if word[FD] >= 0:
        status = _send_zero(handle)
    exchange_int64(handle + LOCK * 8, 0)
    return 0 if status == STALE else 1
