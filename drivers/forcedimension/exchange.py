"""Memory and functions of the servo loop: one exchange with the library in each direction, conversion of frames.

The library's frame has x towards the user, y to the right, z up. The world has x to the right, y away from the user, z
up: world (x, y, z) = (y, -x, z), for positions, forces and torques, and for both sides of the orientation, so that an
unrotated handle is unrotated in both frames.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numba import types

from softfinger.drivers.base import (
    FORCE_OFF,
    HELD,
    LOST,
    OK,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_SIZE,
    SAMPLE_TIME,
    STALE,
    TIMEOUT,
    WITHHELD,
)
from softfinger.drivers.block import counter, function, lay_out, numbers, raw_bytes, try_lock, unlock, word
from softfinger.drivers.forcedimension.library import ERROR_TIMEOUT
from softfinger.drivers.samples import convert_matrix, copy_sample, is_finite, is_zero, store_pose
from softfinger.drivers.system.libc import IO_SIGNATURE, TIMESPEC_WORDS, read_monotonic_ns
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.foreign import call_int32
from softfinger.proxy.kernels.jit.memory import float64_at, int32_at, int64_at

STATUS_WORDS: Final = 17


class Fields(NamedTuple):
    """Fields of the block."""

    # functions of the library
    get_frame: Annotated[int, function("dhdGetPositionAndOrientationFrame")]
    get_buttons: Annotated[int, function("dhdGetButtonMask")]
    get_gripper: Annotated[int, function("dhdGetGripperAngleRad")]
    get_status: Annotated[int, function("dhdGetStatus")]
    get_error: Annotated[int, function("dhdErrorGetLast")]
    set_wrench: Annotated[int, function("dhdSetForceAndTorqueAndGripperForce")]
    get_position: Annotated[int, function("dhdGetPosition")]
    # settings
    id: Annotated[int, word("the library's number of the device")]
    has_frame: Annotated[
        int,
        word("whether the library returns a frame; otherwise it returns a position, and the rotation is the identity"),
    ]
    gripper_sign: Annotated[int, word("sign of the angle of an open gripper: -1 left-handed, 1; 0 without one")]
    has_torque: Annotated[int, word("whether the device has motors for torque; otherwise no torque is sent")]
    status_every: Annotated[int, word("number of reads between two status requests")]
    started_at: Annotated[int, word("ns")]
    # written by several threads
    open: Annotated[int, word("whether the library may be called")]
    armed: Annotated[int, word("whether forces may be sent")]
    stopped: Annotated[int, word("permanent; set before `armed` is cleared, so that a concurrent `arm` has no effect")]
    lock: Annotated[int, word("lock: set during a call, since the library is not documented as thread-safe")]
    # counters and last errors
    reads: Annotated[int, counter("readings")]
    reads_guarded: Annotated[int, counter("reads answered with the previous reading, TIMEGUARD")]
    writes: Annotated[int, counter("forces sent")]
    writes_guarded: Annotated[int, counter("of these, withheld by the library, TIMEGUARD")]
    saturated: Annotated[int, counter("forces reduced to the limit of the motors")]
    error: Annotated[int, word("error code of the library at the failure")]
    cause: Annotated[int, word("reason for which the device disabled its force; -1: none")]
    faulty: Annotated[int, word("error code of the device, 0 for none")]
    # buffers of the calls
    timespec: Annotated[int, numbers("struct timespec of the clock", TIMESPEC_WORDS)]
    gripper: Annotated[int, numbers("rad", 1)]
    frame: Annotated[int, numbers("position, then the matrix row by row", 12)]
    status: Annotated[int, raw_bytes("int32 each", 4 * STATUS_WORDS)]
    sample: Annotated[int, numbers("last sample returned to the servo", SAMPLE_SIZE)]


AT: Final = lay_out(Fields)


# Indices of the library's status.
STATUS_FORCE: Final = 5
STATUS_ERROR: Final = 9
STATUS_CAUSE: Final = 14

NS_PER_S: Final = 1_000_000_000


@jit
def _read_status(handle: int) -> int:
    """Read the device's status; return FORCE_OFF and store the cause if its force is off or it reports an error."""
    word = int64_at(handle)
    status = int32_at(handle + 8 * AT.status)
    if call_int32(word[AT.get_status], (status, np.int32(word[AT.id]))) < 0:
        return LOST
    if status[STATUS_FORCE] != 0 and status[STATUS_ERROR] == 0:
        return OK
    word[AT.cause] = status[STATUS_CAUSE]
    word[AT.faulty] = status[STATUS_ERROR]
    return FORCE_OFF


@jit
def _status_of_error(handle: int) -> int:
    """Return the status for a failed call, from the library's error of this thread."""
    word = int64_at(handle)
    word[AT.error] = call_int32(word[AT.get_error], ())
    if word[AT.error] == ERROR_TIMEOUT:
        return TIMEOUT
    _read_status(handle)  # a device that still answers may report the cause
    return LOST


@jit
def _convert_pose(handle: int, sample: Any) -> None:
    """Convert the library's pose to the world frame; the orientation is NaN if its matrix is not a rotation."""
    p, m = float64_at(handle + 8 * AT.frame), float64_at(handle + 8 * (AT.frame + 3))
    rows = ((m[4], -m[3], m[5]), (-m[1], m[0], -m[2]), (m[7], -m[6], m[8]))
    store_pose(sample, (p[1], -p[0], p[2]), convert_matrix(rows))


@jit
def _read_locked(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[AT.open] == 0:
        return LOST
    device = np.int32(word[AT.id])
    at = handle + 8 * AT.frame
    x, y, z = float64_at(at), float64_at(at + 8), float64_at(at + 16)
    if word[AT.has_frame] != 0:
        code = call_int32(word[AT.get_frame], (x, y, z, float64_at(at + 24), device))
    else:
        code = call_int32(word[AT.get_position], (x, y, z, device))
    if code < 0:
        return _status_of_error(handle)
    buttons = call_int32(word[AT.get_buttons], (device,))
    if (
        word[AT.gripper_sign] != 0
        and call_int32(word[AT.get_gripper], (float64_at(handle + 8 * AT.gripper), device)) < 0
    ):
        return _status_of_error(handle)
    word[AT.reads] += 1
    if word[AT.armed] != 0 and word[AT.reads] % word[AT.status_every] == 0:
        status = _read_status(handle)
        if status != OK:
            return status if status == FORCE_OFF else _status_of_error(handle)
    _convert_pose(handle, sample)
    sample[SAMPLE_TIME] = float(read_monotonic_ns(handle + 8 * AT.timespec) - word[AT.started_at]) / NS_PER_S
    sample[SAMPLE_BUTTONS] = float(np.int64(buttons) & 0xFFFFFFFF)
    sample[SAMPLE_GRIPPER] = word[AT.gripper_sign] * float64_at(handle + 8 * AT.gripper)[0]
    copy_sample(sample, float64_at(handle + 8 * AT.sample))
    if code != 0:
        word[AT.reads_guarded] += 1
        return STALE
    return OK


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
    if word[AT.armed] == 0 or word[AT.stopped] != 0:
        return OK if is_zero(wrench, 6) else WITHHELD
    is_usable = is_finite(wrench, 6)
    fx, fy, fz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if is_usable:
        fx, fy, fz = -wrench[1], wrench[0], wrench[2]
        if word[AT.has_torque] != 0:
            tx, ty, tz = -wrench[4], wrench[3], wrench[5]
    code = call_int32(word[AT.set_wrench], (fx, fy, fz, tx, ty, tz, 0.0, np.int32(word[AT.id])))
    if code < 0:
        return _status_of_error(handle)
    word[AT.writes] += 1
    if code == 1:
        word[AT.writes_guarded] += 1
    elif code == 2:
        word[AT.saturated] += 1
    if not is_usable:
        return WITHHELD
    if code == 1:  # probably not sent; if it was, this assumption errs towards less force
        return HELD
    return OK if code == 0 else STALE


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    if not try_lock(handle, AT.lock):
        return WITHHELD
    status = _write_locked(handle, wrench)
    unlock(handle, AT.lock)
    return status


@c_function(types.int64(types.int64))
def lock_library(handle: int) -> int:
    """Acquire the lock and return 1; return 0 if the loop is inside the library, and try again."""
    return int(try_lock(handle, AT.lock))


@c_function(types.int64(types.int64))
def unlock_library(handle: int) -> int:
    unlock(handle, AT.lock)
    return 0
