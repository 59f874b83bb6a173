"""Exchange with a board on a file descriptor: each tick, after a pause of the loop, and during silence of the board.

A tick never waits: it reads everything received, uses the latest sample, and sends one packet. During a silence longer
than `quiet` it sends no force: computed for an old position, the force may push the arm in the wrong direction. It
wakes the board every `kick`, and reports a failure after `timeout_after`. After a pause of the loop (`pause`) it
discards queued samples and waits for a current one. WITHHELD reports that zero replaced the force, so that the guard
fades the force in again. HELD reports that a force was not sent, because the device keeps the previous one.

A driver implements six kernels, dispatched by the type of a named tuple that it defines: `drain`, `pose`, `busy`,
`send_zero`, `command` and `wake`. `serial.exchange` is the shortest example.
"""

from __future__ import annotations

import time
from math import isfinite
from typing import Annotated, Any, Final, NamedTuple, Protocol

from numba import types

from softfinger.drivers.base import (
    HELD,
    LOST,
    OK,
    PROTOCOL,
    SAMPLE_SIZE,
    SAMPLE_TIME,
    STALE,
    TIMEOUT,
    WITHHELD,
    DeviceInfo,
)
from softfinger.drivers.block import Block, lay_out, numbers, word
from softfinger.drivers.mounting import Mounting
from softfinger.drivers.pause import RESUME_NS, RESUME_WAIT_NS, heard_at
from softfinger.drivers.system.libc import IO_SIGNATURE, TIMESPEC_WORDS, monotonic_ns, poll_fd
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.memory import exchange_int64, float64_at, int64_at

TORQUE_MAX_NM: Final = 1e2
"""No motor turns the handle, but torque is accepted: contact and telemetry use it."""
WAIT_MS: Final = 10
"""Duration of one wait for a current sample."""

_POLLIN: Final = 1 << 32  # `events` of a struct pollfd, read as one little-endian word


class Words(NamedTuple):
    """Fields of every exchange; the fields of the driver follow."""

    fd: Annotated[int, word("file descriptor, below 0 once it is closed")]
    armed: Annotated[int, word("whether a force may go out")]
    lock: Annotated[int, word("held while something is written")]
    sensed: Annotated[int, word("whether there is a sample to repeat")]
    loaded: Annotated[int, word("whether the last packet that was taken had a force; kept by the driver")]
    left: Annotated[int, word("bytes of it that the device has not taken yet; kept by the driver")]
    misread: Annotated[int, word("bytes since the newest sample that make none; kept by the driver, else 0")]
    answer: Annotated[int, word("so many misread ones are an answer that is not in the protocol")]
    opened_at: Annotated[int, word("ns")]
    heard_at: Annotated[int, word("ns, when the newest sample was read")]
    read_at: Annotated[int, word("ns, when the loop last read")]
    kicked_at: Annotated[int, word("ns")]
    quiet: Annotated[int, word("ns of silence, after which it gets no force")]
    kick: Annotated[int, word("ns from one kick into a silence to the next")]
    kick_awaiting: Annotated[int, word("ns, the same while a sample of now is awaited")]
    timeout_after: Annotated[int, word("ns of silence")]
    poll: Annotated[int, word("struct pollfd")]
    timespec: Annotated[int, numbers("for the clock", TIMESPEC_WORDS)]
    sample: Annotated[int, numbers("the last one", SAMPLE_SIZE)]


TALK: Final = lay_out(Words)


class Times(NamedTuple):
    """Time spans of an exchange, s; see `Words`."""

    quiet: float
    kick: float
    kick_awaiting: float
    timeout: float


def begin(block: Block, fd: int, times: Times, answer: int = 1) -> None:
    """Initialize the fields of an exchange on `fd`; `answer` as in `Words`."""
    at = block.word
    at[TALK.fd], at[TALK.armed], at[TALK.answer] = fd, 1, answer
    at[TALK.opened_at] = time.monotonic_ns()
    spans = (TALK.quiet, TALK.kick, TALK.kick_awaiting, TALK.timeout_after)
    for place, seconds in zip(spans, times, strict=True):
        at[place] = round(seconds * 1e9)


class Board(Protocol):
    """Keys of a rig for any board."""

    @property
    def mounting(self) -> Mounting: ...
    @property
    def workspace_radius_m(self) -> float: ...
    @property
    def force_max_n(self) -> float: ...
    @property
    def stiffness_max_n_per_m(self) -> float: ...
    @property
    def damping_max_ns_per_m(self) -> float: ...


def info_of(board: Board, name: str, sensed_dof: int, actuated_dof: int = 3) -> DeviceInfo:
    """Return the capabilities of a board: no motors for the handle's rotation, workspace a box around its origin."""
    x, y, z = (float(v) for v in board.mounting.position_m)
    r = board.workspace_radius_m
    return DeviceInfo(
        name=name,
        sensed_dof=sensed_dof,
        actuated_dof=actuated_dof,
        force_max_n=board.force_max_n,
        torque_max_nm=TORQUE_MAX_NM,
        stiffness_max_n_per_m=board.stiffness_max_n_per_m,
        damping_max_ns_per_m=board.damping_max_ns_per_m,
        workspace_min_m=(x - r, y - r, z - r),
        workspace_max_m=(x + r, y + r, z + r),
    )


# --- kernels of a driver ---------------------------------------------------------------------------


@by_type
def drain(driver: Any, handle: int) -> Any:
    """Read until nothing is left and store the latest sample. Return the number of samples, or a status below 0."""


@by_type
def pose(driver: Any, handle: int) -> Any:
    """Convert the latest sample into TALK.sample, except its time. Return False if it contains no pose."""


@by_type
def busy(driver: Any, handle: int, deaf: bool) -> Any:
    """Return True if only a zero that ends a force may be sent now; `deaf`: there is no current sample."""


@by_type
def send_zero(driver: Any, handle: int) -> Any:
    """Send a zero. Return OK, HELD if the device accepts nothing at the moment, or a status below 0."""


@by_type
def command(driver: Any, handle: int, wrench: Any) -> Any:
    """Send a wrench. Return like `send_zero`, or STALE if the driver limited it."""


@by_type
def wake(driver: Any, handle: int) -> Any:
    """Send a packet without force that makes a silent device answer. Return like `send_zero`."""


# --- common to all drivers -------------------------------------------------------------------------


@jit
def _now(handle: int) -> int:
    return monotonic_ns(handle + 8 * TALK.timespec)


@jit
def _kick(driver: Any, handle: int) -> int:
    """Wake the device, unless another thread is writing to stop it: then its write wakes the device."""
    if exchange_int64(handle + 8 * TALK.lock, 1) != 0:
        return STALE
    status: int = wake(driver, handle)
    int64_at(handle)[TALK.kicked_at] = _now(handle)
    exchange_int64(handle + 8 * TALK.lock, 0)
    return status


@jit
def _mute(handle: int, misread: int) -> int:
    """Return the status of a silence in which `misread` unusable bytes arrived."""
    return PROTOCOL if misread >= int64_at(handle)[TALK.answer] else TIMEOUT


@jit
def _ready(handle: int, wait_ms: int) -> None:
    """Wait until the device has sent something, or `wait_ms` have passed."""
    at = int64_at(handle)
    at[TALK.poll] = at[TALK.fd] | _POLLIN
    poll_fd(int64_at(handle + 8 * TALK.poll), 1, wait_ms)


@jit
def _await(driver: Any, handle: int) -> int:
    """Discard queued samples and wait for a current one, waking the device. Return like `drain`.

    The wait is short if there is a sample to repeat.
    """
    at = int64_at(handle)
    came: int = drain(driver, handle)
    if came >= 0:
        _ready(handle, 0)  # poll makes a terminal deliver bytes in transit before it reports that there are none
        came = drain(driver, handle)
    begun = now = _now(handle)
    misread = at[TALK.misread]
    running = at[TALK.sensed] != 0
    at[TALK.kicked_at] = begun - at[TALK.kick_awaiting]
    while came >= 0:
        if now - at[TALK.kicked_at] >= at[TALK.kick_awaiting]:
            status = _kick(driver, handle)
            if status < 0:
                return status
        _ready(handle, WAIT_MS)
        came = drain(driver, handle)
        if came != 0:
            break
        now = _now(handle)
        if running and now - begun > RESUME_WAIT_NS:
            break
        if not running and now - begun > at[TALK.timeout_after]:
            return _mute(handle, at[TALK.misread] - misread)
    return came


@jit
def read_once(driver: Any, handle: int, sample: Any) -> int:
    """Implement `read` of a driver."""
    at = int64_at(handle)
    if at[TALK.fd] < 0:
        return LOST
    now = _now(handle)
    loaded = at[TALK.loaded] != 0
    paused = now - at[TALK.read_at] > RESUME_NS or at[TALK.sensed] == 0
    if paused:
        at[TALK.heard_at] = heard_at(at[TALK.heard_at], at[TALK.read_at], now, at[TALK.quiet])
    at[TALK.read_at] = now
    came = _await(driver, handle) if paused else drain(driver, handle)
    if came < 0:
        return int(came)
    kept = float64_at(handle + 8 * TALK.sample)
    status = STALE
    if came > 0:
        at[TALK.heard_at] = _now(handle)
        if not pose(driver, handle):
            return PROTOCOL
        kept[SAMPLE_TIME] = (at[TALK.heard_at] - at[TALK.opened_at]) * 1e-9
        at[TALK.sensed] = 1
        status = OK
    else:
        silence = now - at[TALK.heard_at]
        if silence > at[TALK.timeout_after]:
            return _mute(handle, at[TALK.misread])
        if silence > at[TALK.quiet] and now - at[TALK.kicked_at] >= at[TALK.kick]:
            kicked = _kick(driver, handle)
            if kicked < 0:
                return kicked
    if paused:
        at[TALK.read_at] = _now(handle)  # waiting for the device is no pause of the loop
    if loaded and at[TALK.loaded] == 0:
        status = WITHHELD  # waking has removed the force, and the answer to it must not restore the force at once
    for k in range(SAMPLE_SIZE):
        sample[k] = kept[k]
    return status


@jit
def write_once(driver: Any, handle: int, wrench: Any) -> int:
    """Implement `write` of a driver."""
    at = int64_at(handle)
    # Never wait here: the lock's owner may be stopping the device, and then refusing is right as well.
    if exchange_int64(handle + 8 * TALK.lock, 1) != 0:
        return WITHHELD
    finite, zero = True, True
    for k in range(3):  # no motor turns the handle: torque is accepted, but not displayed
        finite = finite and isfinite(wrench[k])
        zero = zero and wrench[k] == 0.0
    status = OK
    if at[TALK.fd] < 0:
        status = OK if zero else WITHHELD
    else:
        deaf = _now(handle) - at[TALK.heard_at] > at[TALK.quiet] or at[TALK.sensed] == 0
        if zero or not finite or not at[TALK.armed] or deaf:
            if at[TALK.loaded] != 0 or not busy(driver, handle, deaf):
                status = send_zero(driver, handle)
            if status >= 0 and not zero:
                status = WITHHELD
        else:
            status = command(driver, handle, wrench)
    exchange_int64(handle + 8 * TALK.lock, 0)
    return status


@jit
def silence_once(driver: Any, handle: int) -> int:
    """Disarm and send a zero. Return 1 if that is done, 0 if it was not accepted and the call must be repeated."""
    at = int64_at(handle)
    at[TALK.armed] = 0
    if exchange_int64(handle + 8 * TALK.lock, 1) != 0:
        return 0  # a write is in progress
    status = OK
    if at[TALK.fd] >= 0:
        status = send_zero(driver, handle)
    exchange_int64(handle + 8 * TALK.lock, 0)
    return 0 if status == HELD or at[TALK.left] > 0 else 1


class Functions(NamedTuple):
    """C functions of a driver: `read` and `write` for the servo, `silence(handle)` as `silence_once`."""

    read: Any
    write: Any
    silence: Any


def c_functions(driver: tuple[()]) -> Functions:
    """Compile the exchange of a driver; its kernels must be registered for the type of `driver` before."""

    @c_function(IO_SIGNATURE)
    def read(handle: int, sample: Any) -> int:
        return read_once(driver, handle, sample)

    @c_function(IO_SIGNATURE)
    def write(handle: int, wrench: Any) -> int:
        return write_once(driver, handle, wrench)

    @c_function(types.int64(types.int64))
    def silence(handle: int) -> int:
        return silence_once(driver, handle)

    return Functions(read, write, silence)
