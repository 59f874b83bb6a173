"""What the servo loop calls: one exchange with the library each way, and the turn between its frame and the world's.

The library's frame has x towards the user, y to the right, z up. The world's has x to the right, y away from the user,
z up: world (x, y, z) = (y, -x, z), for positions, forces and torques, and for both sides of the orientation, so that a
handle at rest is not turned.
"""

from __future__ import annotations

from math import isfinite, nan
from typing import Any, Final

import numpy as np
from numba import types

from softfinger.drivers.base import (
    FORCE_OFF,
    LOST,
    OK,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_SIZE,
    SAMPLE_TIME,
    STALE,
    TIMEOUT,
)
from softfinger.drivers.forcedimension.library import ERROR_TIMEOUT
from softfinger.drivers.libc import IO_SIGNATURE, monotonic_ns
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.foreign import call_int32
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int32_at, int64_at
from softfinger.proxy.kernels.rotations import from_matrix

# Words of the block behind the handle. Addresses of the library's functions:
GET_FRAME: Final = 0
GET_BUTTONS: Final = 1
GET_GRIPPER: Final = 2
GET_STATUS: Final = 3
GET_ERROR: Final = 4
SET_WRENCH: Final = 5
# Settings:
ID: Final = 6
HAS_GRIPPER: Final = 7
TURNS: Final = 8  # whether motors turn the handle: else no torque is sent
STATUS_EVERY: Final = 9  # reads from one question for the status to the next
STARTED_NS: Final = 10
# Shared with other threads:
OPEN: Final = 11
ARMED: Final = 12
LOCK: Final = 13  # held while the library is called: it is not said to bear two threads
# Counts and what was said last:
READS: Final = 14
READS_GUARDED: Final = 15  # reads that the library answered with the last reading, TIMEGUARD
WRITES: Final = 16
WRITES_GUARDED: Final = 17
SATURATED: Final = 18  # forces that the motors could not give in full
ERROR: Final = 19  # of the library, at the failure
CAUSE: Final = 20  # why the device turned its force off; -1: it did not
FAULTY: Final = 21  # its error word, where that was not 0
# Memory for the calls:
TIMESPEC: Final = 22
GRIPPER: Final = 24  # a float64: rad
FRAME: Final = 25  # 12 float64: position, then the matrix row by row
STATUS: Final = 37  # 17 int32
SAMPLE: Final = 46  # the last sample, as the servo got it
WORDS: Final = SAMPLE + SAMPLE_SIZE

# Of the library's status words.
STATUS_FORCE: Final = 5
STATUS_ERROR: Final = 9
STATUS_CAUSE: Final = 14

NS_PER_S: Final = 1_000_000_000
NOT_A_ROTATION: Final = 0.01
"""How far the rows' lengths and the determinant may be from 1; a matrix that is off by more is a fault, not a sensed
rotation. Rows of length 1 that span a volume of 1 are at right angles."""


@jit
def _device_time(handle: int) -> float:
    word = int64_at(handle)
    return float(monotonic_ns(handle + 8 * TIMESPEC) - word[STARTED_NS]) / NS_PER_S


@jit
def _ask_status(handle: int) -> int:
    """Ask for the status words; FORCE_OFF when the device has turned its force off or reports an error, noted why."""
    word = int64_at(handle)
    status = int32_at(handle + 8 * STATUS)
    if call_int32(word[GET_STATUS], (status, np.int32(word[ID]))) < 0:
        return LOST
    if status[STATUS_FORCE] != 0 and status[STATUS_ERROR] == 0:
        return OK
    word[CAUSE] = status[STATUS_CAUSE]
    word[FAULTY] = status[STATUS_ERROR]
    return FORCE_OFF


@jit
def _failed(handle: int) -> int:
    """What a call that returned -1 means, from the library's error of this thread."""
    word = int64_at(handle)
    word[ERROR] = call_int32(word[GET_ERROR], ())
    if word[ERROR] == ERROR_TIMEOUT:
        return TIMEOUT
    _ask_status(handle)  # a device that still answers may say why
    return LOST


@jit
def _take_frame(handle: int, sample: Any) -> None:
    """The library's pose in the world frame; NaN for an orientation that is no rotation."""
    p = float64_at(handle + 8 * FRAME)
    sample[0] = p[1]
    sample[1] = -p[0]
    sample[2] = p[2]
    m = float64_at(handle + 8 * (FRAME + 3))
    world = ((m[4], -m[3], m[5]), (-m[1], m[0], -m[2]), (m[7], -m[6], m[8]))
    rotation = abs(vec3.dot(world[0], vec3.cross(world[1], world[2])) - 1.0) < NOT_A_ROTATION
    for i in range(3):
        rotation = rotation and abs(vec3.norm(world[i]) - 1.0) < NOT_A_ROTATION
    if rotation:
        q = from_matrix(world)
        for k in range(4):
            sample[3 + k] = q[k]
    else:
        for k in range(4):
            sample[3 + k] = nan


@jit
def _read_locked(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    if word[OPEN] == 0:
        return LOST
    device = np.int32(word[ID])
    at = handle + 8 * FRAME
    code = call_int32(
        word[GET_FRAME],
        (float64_at(at), float64_at(at + 8), float64_at(at + 16), float64_at(at + 24), device),
    )
    if code < 0:
        return _failed(handle)
    buttons = call_int32(word[GET_BUTTONS], (device,))
    if word[HAS_GRIPPER] != 0 and call_int32(word[GET_GRIPPER], (float64_at(handle + 8 * GRIPPER), device)) < 0:
        return _failed(handle)
    word[READS] += 1
    if word[ARMED] != 0 and word[READS] % word[STATUS_EVERY] == 0:
        status = _ask_status(handle)
        if status != OK:
            return status if status == FORCE_OFF else _failed(handle)
    _take_frame(handle, sample)
    sample[SAMPLE_TIME] = _device_time(handle)
    sample[SAMPLE_BUTTONS] = float(np.int64(buttons) & 0xFFFFFFFF)
    sample[SAMPLE_GRIPPER] = float64_at(handle + 8 * GRIPPER)[0]  # 0 as it was where there is none
    kept = float64_at(handle + 8 * SAMPLE)
    for k in range(SAMPLE_SIZE):
        kept[k] = sample[k]
    if code != 0:
        word[READS_GUARDED] += 1
        return STALE
    return OK


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    # Never wait here: who holds the lock is stopping the device.
    if exchange_int64(handle + 8 * LOCK, 1) != 0:
        kept = float64_at(handle + 8 * SAMPLE)
        for k in range(SAMPLE_SIZE):
            sample[k] = kept[k]
        return STALE
    status = _read_locked(handle, sample)
    exchange_int64(handle + 8 * LOCK, 0)
    return status


@jit
def _write_locked(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    if word[ARMED] == 0:
        for k in range(6):
            if wrench[k] != 0.0:
                return STALE
        return OK
    usable = True
    for k in range(6):
        if not isfinite(wrench[k]):
            usable = False
    fx, fy, fz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if usable:
        fx, fy, fz = -wrench[1], wrench[0], wrench[2]
        if word[TURNS] != 0:
            tx, ty, tz = -wrench[4], wrench[3], wrench[5]
    code = call_int32(word[SET_WRENCH], (fx, fy, fz, tx, ty, tz, 0.0, np.int32(word[ID])))
    if code < 0:
        return _failed(handle)
    word[WRITES] += 1
    if code == 0:
        return OK if usable else STALE
    if code == 1:
        word[WRITES_GUARDED] += 1
    else:
        word[SATURATED] += 1
    return STALE


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    if exchange_int64(handle + 8 * LOCK, 1) != 0:
        return STALE
    status = _write_locked(handle, wrench)
    exchange_int64(handle + 8 * LOCK, 0)
    return status


@c_function(types.int64(types.int64))
def lock(handle: int) -> int:
    """Take the lock; 0 when the loop is in the library just now and it must be tried again."""
    return 1 if exchange_int64(handle + 8 * LOCK, 1) == 0 else 0


@c_function(types.int64(types.int64))
def unlock(handle: int) -> int:
    exchange_int64(handle + 8 * LOCK, 0)
    return 0
