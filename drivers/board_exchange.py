"""Exchange with a board on a file descriptor: each tick, after a pause of the loop, and during silence of the board.

A tick never waits: it reads everything received, uses the latest sample, and sends one packet. During a silence longer
than `quiet` it sends no force: computed for an old position, the force may push the arm in the wrong direction. It
wakes the board every `kick`, and reports a failure after `timeout_after`. After a pause of the loop (`samples`) it
discards queued samples and waits for a current one. WITHHELD reports that zero replaced the force, so that the guard
fades the force in again. HELD reports that a force was not sent, because the device keeps the previous one.

A driver implements six kernels, dispatched by the type of a named tuple that it defines: `drain`, `convert_sample`,
`must_withhold`, `send_zero`, `send_wrench` and `wake`. `serial.exchange` is the shortest example.
"""

from __future__ import annotations

import time
from typing import Annotated, Any, Final, NamedTuple

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
)
from softfinger.drivers.block import Block, lay_out, numbers, try_lock, unlock, word
from softfinger.drivers.samples import (
    CURRENT_WAIT_MAX_NS,
    PAUSE_MIN_NS,
    copy_sample,
    is_finite,
    is_zero,
    shift_sample_time,
)
from softfinger.drivers.system.libc import IO_SIGNATURE, TIMESPEC_WORDS, read_monotonic_ns, wait_readable
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at

WAIT_MS: Final = 10
"""Duration of one wait for a current sample."""


class Fields(NamedTuple):
    """Fields of every exchange; the fields of the driver follow."""

    fd: Annotated[int, word("file descriptor, below 0 once it is closed")]
    armed: Annotated[int, word("whether forces may be sent")]
    lock: Annotated[int, word("lock: set during a write")]
    has_sample: Annotated[int, word("whether a sample exists that can be repeated")]
    has_force: Annotated[int, word("whether the last accepted packet had a force; written by the driver")]
    unsent_bytes: Annotated[
        int, word("bytes of the last packet that the device has not accepted yet; written by the driver")
    ]
    misread_bytes: Annotated[
        int, word("bytes since the latest sample that are no valid data; 0 if the driver does not count them")
    ]
    misread_max: Annotated[int, word("number of such bytes at which the protocol counts as wrong")]
    opened_at: Annotated[int, word("time at which the device was opened, ns")]
    sampled_at: Annotated[int, word("time of the latest sample, ns")]
    read_at: Annotated[int, word("time of the last read by the loop, ns")]
    kicked_at: Annotated[int, word("time of the last kick, ns")]
    quiet: Annotated[int, word("time without data after which no force is sent, ns")]
    kick: Annotated[int, word("time between two kicks of a silent device, ns")]
    kick_awaiting: Annotated[int, word("the same while the driver waits for a current sample, ns")]
    timeout_after: Annotated[int, word("time without data after which the device counts as lost, ns")]
    poll: Annotated[int, word("struct pollfd for the file descriptor")]
    timespec: Annotated[int, numbers("struct timespec of the clock", TIMESPEC_WORDS)]
    sample: Annotated[int, numbers("last sample", SAMPLE_SIZE)]


BOARD: Final = lay_out(Fields)


class BoardTimes(NamedTuple):
    """Time spans of an exchange, s; see `Fields`."""

    quiet: float
    kick: float
    kick_awaiting: float
    timeout: float


def init_exchange(block: Block, fd: int, times: BoardTimes, misread_max: int = 1) -> None:
    """Initialize the fields of an exchange on `fd`; `misread_max` as in `Fields`."""
    at = block.word
    at[BOARD.fd], at[BOARD.armed], at[BOARD.misread_max] = fd, 1, misread_max
    at[BOARD.opened_at] = time.monotonic_ns()
    spans = (BOARD.quiet, BOARD.kick, BOARD.kick_awaiting, BOARD.timeout_after)
    for field, seconds in zip(spans, times, strict=True):
        at[field] = round(seconds * 1e9)


# --- kernels of a driver ---------------------------------------------------------------------------


@by_type
def drain(driver: Any, handle: int) -> Any:
    """Read until nothing is left and store the latest sample. Return the number of samples, or a status below 0."""


@by_type
def convert_sample(driver: Any, handle: int) -> Any:
    """Convert the latest sample into BOARD.sample, except its time. Return False if it contains no pose."""


@by_type
def must_withhold(driver: Any, handle: int, has_no_sample: bool) -> Any:
    """Return True if only a zero that ends a force may be sent now; `has_no_sample`: there is no current sample."""


@by_type
def send_zero(driver: Any, handle: int) -> Any:
    """Send a zero. Return OK, HELD if the device accepts nothing at the moment, or a status below 0."""


@by_type
def send_wrench(driver: Any, handle: int, wrench: Any) -> Any:
    """Send a wrench. Return like `send_zero`, or STALE if the driver limited it."""


@by_type
def wake(driver: Any, handle: int) -> Any:
    """Send a packet without force to which a silent device replies. Return like `send_zero`."""


# --- common to all drivers -------------------------------------------------------------------------


@jit
def _read_clock(handle: int) -> int:
    return read_monotonic_ns(handle + 8 * BOARD.timespec)


@jit
def _kick(driver: Any, handle: int) -> int:
    """Wake the device, unless another thread is writing to stop it: then its write wakes the device."""
    if not try_lock(handle, BOARD.lock):
        return STALE
    status: int = wake(driver, handle)
    int64_at(handle)[BOARD.kicked_at] = _read_clock(handle)
    unlock(handle, BOARD.lock)
    return status


@jit
def _silence_status(handle: int, misread_bytes: int) -> int:
    """Return the status of a silence in which `misread_bytes` unusable bytes arrived."""
    return PROTOCOL if misread_bytes >= int64_at(handle)[BOARD.misread_max] else TIMEOUT


@jit
def _await(driver: Any, handle: int) -> int:
    """Discard queued samples and wait for a current one, waking the device. Return like `drain`.

    The wait is short if there is a sample to repeat.
    """
    at = int64_at(handle)
    poll_word = handle + 8 * BOARD.poll
    count: int = drain(driver, handle)
    if count >= 0:  # poll makes a terminal deliver bytes in transit before it reports that there are none
        wait_readable(at[BOARD.fd], 0, poll_word)
        count = drain(driver, handle)
    start = now = _read_clock(handle)
    misread_bytes = at[BOARD.misread_bytes]
    is_running = at[BOARD.has_sample] != 0
    at[BOARD.kicked_at] = start - at[BOARD.kick_awaiting]
    while count >= 0:
        if now - at[BOARD.kicked_at] >= at[BOARD.kick_awaiting]:
            status = _kick(driver, handle)
            if status < 0:
                return status
        wait_readable(at[BOARD.fd], WAIT_MS, poll_word)
        count = drain(driver, handle)
        if count != 0:
            break
        now = _read_clock(handle)
        if is_running and now - start > CURRENT_WAIT_MAX_NS:
            break
        if not is_running and now - start > at[BOARD.timeout_after]:
            return _silence_status(handle, at[BOARD.misread_bytes] - misread_bytes)
    return count


@jit
def read_once(driver: Any, handle: int, sample: Any) -> int:
    at = int64_at(handle)
    if at[BOARD.fd] < 0:
        return LOST
    now = _read_clock(handle)
    had_force = at[BOARD.has_force] != 0
    was_paused = now - at[BOARD.read_at] > PAUSE_MIN_NS or at[BOARD.has_sample] == 0
    if was_paused:
        at[BOARD.sampled_at] = shift_sample_time(at[BOARD.sampled_at], at[BOARD.read_at], now, at[BOARD.quiet])
    at[BOARD.read_at] = now
    count = _await(driver, handle) if was_paused else drain(driver, handle)
    if count < 0:
        return int(count)
    last_sample = float64_at(handle + 8 * BOARD.sample)
    status = STALE
    if count > 0:
        at[BOARD.sampled_at] = _read_clock(handle)
        if not convert_sample(driver, handle):
            return PROTOCOL
        last_sample[SAMPLE_TIME] = (at[BOARD.sampled_at] - at[BOARD.opened_at]) * 1e-9
        at[BOARD.has_sample] = 1
        status = OK
    else:
        silence = now - at[BOARD.sampled_at]
        if silence > at[BOARD.timeout_after]:
            return _silence_status(handle, at[BOARD.misread_bytes])
        if silence > at[BOARD.quiet] and now - at[BOARD.kicked_at] >= at[BOARD.kick]:
            wake_status = _kick(driver, handle)
            if wake_status < 0:
                return wake_status
    if was_paused:
        at[BOARD.read_at] = _read_clock(handle)  # waiting for the device is not a pause of the loop
    if had_force and at[BOARD.has_force] == 0:
        status = WITHHELD  # waking has removed the force, and the answer to it must not restore the force at once
    copy_sample(last_sample, sample)
    return status


@jit
def write_once(driver: Any, handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if not try_lock(handle, BOARD.lock):
        return WITHHELD
    zero = is_zero(wrench, 3)  # no motor turns the handle: torque is accepted, but not displayed
    status = OK
    if at[BOARD.fd] < 0:
        status = OK if zero else WITHHELD
    else:
        has_no_sample = _read_clock(handle) - at[BOARD.sampled_at] > at[BOARD.quiet] or at[BOARD.has_sample] == 0
        if zero or not is_finite(wrench, 3) or not at[BOARD.armed] or has_no_sample:
            if at[BOARD.has_force] != 0 or not must_withhold(driver, handle, has_no_sample):
                status = send_zero(driver, handle)
            if status >= 0 and not zero:
                status = WITHHELD
        else:
            status = send_wrench(driver, handle, wrench)
    unlock(handle, BOARD.lock)
    return status


@jit
def disarm_and_zero_once(driver: Any, handle: int) -> int:
    """Disarm and send a zero. Return 1 if that is done, 0 if it was not accepted and the call must be repeated."""
    at = int64_at(handle)
    at[BOARD.armed] = 0
    if not try_lock(handle, BOARD.lock):
        return 0  # a write is in progress
    status = OK
    if at[BOARD.fd] >= 0:
        status = send_zero(driver, handle)
    unlock(handle, BOARD.lock)
    return 0 if status == HELD or at[BOARD.unsent_bytes] > 0 else 1


class Functions(NamedTuple):
    """C functions of a driver: `read` and `write` for the servo, and `disarm_and_zero`, see `disarm_and_zero_once`."""

    read: Any
    write: Any
    disarm_and_zero: Any


def compile_functions(driver: tuple[()]) -> Functions:
    """Compile the exchange of a driver; its kernels must be registered for the type of `driver` before."""

    @c_function(IO_SIGNATURE)
    def read(handle: int, sample: Any) -> int:
        return read_once(driver, handle, sample)

    @c_function(IO_SIGNATURE)
    def write(handle: int, wrench: Any) -> int:
        return write_once(driver, handle, wrench)

    @c_function(types.int64(types.int64))
    def disarm_and_zero(handle: int) -> int:
        return disarm_and_zero_once(driver, handle)

    return Functions(read, write, disarm_and_zero)
