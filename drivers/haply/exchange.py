"""Servo's side of the exchange, in nopython mode: read the latest pose from the block, write the wrench to it.

Servo and the service's thread (`exchange_thread`) exchange data through two sequence locks, one for each direction, so
that neither waits for the other. A write wakes the thread. WITHHELD reports zero in place of a force, so that the guard
fades in again: no state for `quiet`, disarmed, or the thread dropped the wrench. HELD reports a force that was not
accepted because the previous one is not sent yet.
"""

from __future__ import annotations

import os
import time
from typing import Annotated, Any, Final, NamedTuple

from softfinger.drivers.base import (
    HELD,
    OK,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_SIZE,
    SAMPLE_TIME,
    STALE,
    TIMEOUT,
    WITHHELD,
)
from softfinger.drivers.block import Block, counter, lay_out, numbers, slot, slot_at, try_lock, unlock, word
from softfinger.drivers.mounting import Mounting
from softfinger.drivers.samples import PAUSE_MIN_NS, copy_sample, is_finite, is_zero, shift_sample_time, store_pose
from softfinger.drivers.system.libc import IO_SIGNATURE, TIMESPEC_WORDS, read_monotonic_ns, write_now
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import float64_array_at, float64_at, int64_at
from softfinger.proxy.kernels.jit.pack import flatten, unpack_at
from softfinger.proxy.kernels.jit.seqlock import refresh, store
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import conjugate, multiply, normalize, rotate

POSE_SIZE: Final = 9
"""Numbers of a pose: position (3,) m, orientation (4,), buttons, and time of arrival (ns, monotonic clock)."""
ARRIVAL_TIME: Final = 8
WRENCH_SIZE: Final = 5
"""Numbers of a wrench: force (3,) N in the service's frame, time of the write (ns, monotonic clock), its number."""
WRITE_TIME: Final = 3
WRENCH_NUMBER: Final = 4


class ServiceFrame(NamedTuple):
    """Parameters of the conversion between the service's frame and the world.

    position     (3,) m  service's origin in the world
    orientation  (4,)    service to world
    force_max    N
    """

    position: Vec3
    orientation: Quaternion
    force_max: float


MODEL_LIKE: Final = ServiceFrame((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0)
MODEL_SIZE: Final = len(flatten(MODEL_LIKE))


class Fields(NamedTuple):
    """Shared fields of a device at the service. Each has a single writer, except `armed`."""

    states: Annotated[int, counter("states received")]
    messages: Annotated[int, counter("messages sent")]
    dropped: Annotated[
        int, counter("forces dropped by the thread: no newer wrench, device disarmed, or service does not read")
    ]
    unasked: Annotated[int, counter("states without a message that they answer")]
    written: Annotated[int, counter("wrenches of the loop")]
    cut: Annotated[int, counter("forces above the limit")]
    held: Annotated[int, counter("forces rejected because the previous one was not sent yet")]
    armed: Annotated[int, word("whether forces may be sent")]
    stopped: Annotated[int, word("permanent: a later or concurrent `arm` has no effect")]
    failed: Annotated[int, word("status that ended the thread, 0 while it runs")]
    handled: Annotated[int, word("number of the latest wrench that the thread has sent or dropped")]
    answered: Annotated[int, word("number of the latest wrench with an answered message")]
    stops_requested: Annotated[int, word("zeros requested by `stop`")]
    stops_answered: Annotated[int, word("of these, answered by the service")]
    wake: Annotated[int, word("eventfd that wakes the thread, below 0 once it is closed")]
    increment: Annotated[int, word("data written to it")]
    lock: Annotated[int, word("lock: set during the write of a wrench")]
    quiet: Annotated[int, word("time without a state after which no force is sent, ns")]
    timeout_after: Annotated[int, word("time without a state after which the device counts as lost, ns")]
    stale: Annotated[int, word("age above which a wrench is outdated, ns")]
    opened_at: Annotated[int, word("time at which the device was opened, ns")]
    read_at: Annotated[int, word("time of the last read by the loop, ns")]
    sampled_at: Annotated[int, word("time at which the state of the loop arrived, ns")]
    pose_sequence_read: Annotated[int, word("sequence number of the latest pose that the loop has read")]
    dropped_reported: Annotated[int, word("`dropped` at the last read")]
    timespec: Annotated[int, numbers("struct timespec of the clock", TIMESPEC_WORDS)]
    model: Annotated[int, numbers("a `ServiceFrame`", MODEL_SIZE)]
    pose: Annotated[int, slot("latest pose in the service's frame", POSE_SIZE)]
    wrench: Annotated[int, slot("newest wrench", WRENCH_SIZE)]
    copied: Annotated[int, numbers("the loop's copy of a pose, which may be torn", POSE_SIZE)]
    outgoing: Annotated[int, numbers("the wrench being written", WRENCH_SIZE)]
    sample: Annotated[int, numbers("last sample", SAMPLE_SIZE)]


AT: Final = lay_out(Fields)


class ServiceTimes(NamedTuple):
    """Time spans of an exchange, s; see `Fields`."""

    quiet: float
    timeout: float
    stale: float


def init_exchange(block: Block, mounting: Mounting, force_max_n: float, times: ServiceTimes) -> None:
    """Initialize the fields of an exchange, and open the eventfd that wakes the thread."""
    word = block.word
    block.numbers(AT.model, MODEL_SIZE)[:] = flatten(ServiceFrame(*mounting.frame(), force_max_n))
    word[AT.opened_at], word[AT.increment] = time.monotonic_ns(), 1
    for field, seconds in zip((AT.quiet, AT.timeout_after, AT.stale), times, strict=True):
        word[field] = round(seconds * 1e9)
    word[AT.wake] = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)


@jit
def _read_pose(handle: int) -> bool:
    """Convert the latest pose to the sample and return True, if the loop has not read it yet."""
    at, sample = int64_at(handle), float64_at(handle + 8 * AT.sample)
    copied = float64_array_at(handle + 8 * AT.copied, POSE_SIZE)
    newest = refresh(slot_at(handle + 8 * AT.pose, POSE_SIZE), at[AT.pose_sequence_read], copied)
    if newest == at[AT.pose_sequence_read]:
        return False
    at[AT.pose_sequence_read] = newest
    model = unpack_at(MODEL_LIKE, handle + 8 * AT.model)
    position = vec3.add(rotate(model.orientation, (copied[0], copied[1], copied[2])), model.position)
    orientation = normalize(multiply(model.orientation, (copied[3], copied[4], copied[5], copied[6])))
    store_pose(sample, position, orientation)
    at[AT.sampled_at] = int(copied[ARRIVAL_TIME])
    sample[SAMPLE_TIME] = (at[AT.sampled_at] - at[AT.opened_at]) * 1e-9
    sample[SAMPLE_BUTTONS] = copied[7]
    sample[SAMPLE_GRIPPER] = 0.0
    return True


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    at = int64_at(handle)
    if at[AT.failed] < 0:
        return int(at[AT.failed])
    now = read_monotonic_ns(handle + 8 * AT.timespec)
    status = OK if _read_pose(handle) else STALE
    silence = now - at[AT.sampled_at]
    if at[AT.read_at] != 0 and now - at[AT.read_at] > PAUSE_MIN_NS and silence > at[AT.quiet]:
        # the thread may have been paused too: neither a silence nor a current pose
        at[AT.sampled_at] = shift_sample_time(at[AT.sampled_at], at[AT.read_at], now, at[AT.quiet])
        status = STALE
    elif silence > at[AT.timeout_after]:
        return TIMEOUT
    at[AT.read_at] = now
    dropped = at[AT.dropped]
    if dropped != at[AT.dropped_reported]:
        at[AT.dropped_reported] = dropped
        status = WITHHELD
    copy_sample(float64_at(handle + 8 * AT.sample), sample)
    return status


@jit
def _limit(handle: int, wrench: Any, now: int) -> tuple[Vec3, int]:
    """Return the force to send in the service's frame, at most `force_max`, and the status of the write."""
    at = int64_at(handle)
    is_armed = at[AT.armed] != 0 and at[AT.stopped] == 0
    if is_zero(wrench, 3):  # torque is ignored: no motor turns the handle
        return (0.0, 0.0, 0.0), OK
    if not is_armed or not is_finite(wrench, 3) or at[AT.wake] < 0 or now - at[AT.sampled_at] > at[AT.quiet]:
        return (0.0, 0.0, 0.0), WITHHELD
    if at[AT.handled] != at[AT.written]:  # replacing that one would skip the force of a tick
        at[AT.held] += 1
        return (0.0, 0.0, 0.0), HELD
    model = unpack_at(MODEL_LIKE, handle + 8 * AT.model)
    force = rotate(conjugate(model.orientation), (wrench[0], wrench[1], wrench[2]))
    size = vec3.norm(force)
    if size <= model.force_max:
        return force, OK
    at[AT.cut] += 1
    return vec3.scale(model.force_max / size, force), STALE


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if at[AT.failed] < 0:
        return OK if is_zero(wrench, 3) else int(at[AT.failed])
    if not try_lock(handle, AT.lock):
        return WITHHELD
    now = read_monotonic_ns(handle + 8 * AT.timespec)
    force, status = _limit(handle, wrench, now)
    if status != HELD:
        outgoing = float64_array_at(handle + 8 * AT.outgoing, WRENCH_SIZE)
        for k in range(3):
            outgoing[k] = force[k]
        at[AT.written] += 1
        outgoing[WRITE_TIME], outgoing[WRENCH_NUMBER] = float(now), float(at[AT.written])
        store(slot_at(handle + 8 * AT.wrench, WRENCH_SIZE), outgoing)
        if at[AT.wake] >= 0:
            write_now(at[AT.wake], handle + 8 * AT.increment, 8)
    unlock(handle, AT.lock)
    return status
