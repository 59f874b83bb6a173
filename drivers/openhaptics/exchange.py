"""Callback of the library's thread, once per millisecond, and functions of the servo loop; neither waits for the other.

The callback reads the device and sends it the latest force of the servo. It SENDS ZERO INSTEAD if that force is older
than the rig allows, if the device is disarmed, if the stylus is docked, after an error, and if the frame itself is
late: the motors keep the last command, so a stalled servo must not leave a force. Each force that is not sent counts as
a lapse. The servo's next write is then WITHHELD, as is every write while the stylus is docked or frames are late, so
that the guard fades the force in again and telemetry has the force of the motors.

The library's frame has x to the right, y up, z towards the user. World (x, y, z) = (x, -z, y), for positions, forces
and torques, and for both sides of the orientation, so that an unrotated handle is unrotated in both frames.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

import numpy as np
from numba import types

from softfinger.drivers.base import (
    FORCE_OFF,
    HELD,
    LOST,
    OK,
    PROTOCOL,
    SAMPLE_BUTTONS,
    SAMPLE_SIZE,
    SAMPLE_TIME,
    STALE,
    TIMEOUT,
    WITHHELD,
)
from softfinger.drivers.block import slot_at
from softfinger.drivers.openhaptics import library as hd
from softfinger.drivers.openhaptics.block import AT, KNOWN_LAPSES, WRENCH_SIZE, WRITE_TIME
from softfinger.drivers.samples import convert_matrix, copy_sample, is_finite, is_zero, store_pose
from softfinger.drivers.system.libc import IO_SIGNATURE, read_monotonic_ns
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.foreign import call_int32, call_two_int64, call_void
from softfinger.proxy.kernels.jit.memory import float64_array_at, float64_at, int32_at, int64_at, uint8_at
from softfinger.proxy.kernels.jit.seqlock import refresh, store

DONE: Final = 0
CONTINUE: Final = 1
"""Results of the callback: CONTINUE if the library must call it again, else DONE."""

NS_PER_S: Final = 1_000_000_000
MM_PER_M: Final = 1000.0
MNM_PER_NM: Final = 1000.0

PROBE_INKWELL: Final = 0
PROBE_TEMPERATURE: Final = 1
PROBES: Final = 2
"""Frames of the first queries of inkwell and motor temperature, and their number. Not every device has both.

If a device rejects a query, it is not repeated.
"""
TEMPERATURE_EVERY: Final = 100
"""Frames from one query of the motors' temperature to the next."""
MOTORS: Final = 6
ERRORS_PER_FRAME: Final = 8
"""Maximum number of errors removed from the stack per frame; the remainder is removed in the next."""

TIMEOUT_NS: Final = 100_000_000
"""Maximum silence of the library's thread while the servo reads."""
SILENCE_STEP_MAX_NS: Final = 10_000_000
"""Maximum part of the time between two reads that counts as silence, because a stalled loop reads nothing."""


@jit
def convert_status(code: int) -> int:
    if code in (hd.DEVICE_FAULT, hd.COMM_ERROR, hd.COMM_CONFIG_ERROR, hd.BAD_HANDLE):
        return LOST
    if hd.WARM_MOTORS <= code <= hd.FORCE_ERROR:
        return FORCE_OFF
    return PROTOCOL


# --- the library's thread --------------------------------------------------------------------------


@jit
def _is_refused_probe(handle: int, code: int) -> bool:
    """Return True if an error answers a first query of an optional property; then it is not queried again."""
    word = int64_at(handle)
    if code < hd.INVALID_ENUM or code > hd.INVALID_INPUT_TYPE or word[AT.frames] >= PROBES:
        return False
    if word[AT.frames] == PROBE_INKWELL:
        word[AT.has_inkwell] = 0
    else:
        word[AT.has_temperature] = 0
    return True


@jit
def _store_errors(handle: int) -> None:
    """Remove this frame's errors from the stack, and store the gravest: the first fatal one, else the first."""
    word = int64_at(handle)
    for _ in range(ERRORS_PER_FRAME):
        packed, of = call_two_int64(word[AT.get_error], ())
        code, device = packed & 0xFFFFFFFF, of & 0xFFFFFFFF
        if code == 0:
            return
        word[AT.errors] += 1
        if device not in (word[AT.device], hd.INVALID_HANDLE) or _is_refused_probe(handle, code):
            continue
        status = convert_status(code)
        if word[AT.status] == OK or (word[AT.status] == PROTOCOL and status != PROTOCOL):
            word[AT.error], word[AT.internal] = code, packed >> 32
            word[AT.status] = status


@jit
def _read_state(handle: int) -> None:
    word, frames = int64_at(handle), int64_at(handle)[AT.frames]
    call_void(word[AT.get_doubles], (np.int32(hd.CURRENT_POSITION), handle + 8 * AT.position))
    call_void(word[AT.get_doubles], (np.int32(hd.CURRENT_TRANSFORM), handle + 8 * AT.matrix))
    call_void(word[AT.get_integers], (np.int32(hd.CURRENT_BUTTONS), handle + 8 * AT.buttons))
    if word[AT.has_inkwell] != 0 and frames != PROBE_TEMPERATURE:
        call_void(word[AT.get_booleans], (np.int32(hd.CURRENT_INKWELL_SWITCH), handle + 8 * AT.switch))
    if word[AT.has_temperature] != 0 and (
        frames == PROBE_TEMPERATURE or frames % TEMPERATURE_EVERY == TEMPERATURE_EVERY - 1
    ):
        call_void(word[AT.get_doubles], (np.int32(hd.MOTOR_TEMPERATURE), handle + 8 * AT.temperatures))
        most, temperatures = 0.0, float64_at(handle + 8 * AT.temperatures)
        for k in range(MOTORS):
            if isfinite(temperatures[k]):
                most = max(most, temperatures[k])
        word[AT.temperature] = int(1000.0 * min(most, 10.0))


@jit
def _read_wrench(handle: int) -> Any:
    """Return the servo's last complete wrench."""
    word, last_wrench = int64_at(handle), float64_at(handle + 8 * AT.last_wrench)
    read_wrench = float64_array_at(handle + 8 * AT.read_wrench, WRENCH_SIZE)
    sequence = refresh(slot_at(handle + 8 * AT.wrench, WRENCH_SIZE), word[AT.wrench_seen], read_wrench)
    if sequence != word[AT.wrench_seen]:
        word[AT.wrench_seen] = sequence
        for k in range(WRENCH_SIZE):
            last_wrench[k] = read_wrench[k]
    return last_wrench


@jit
def _send_vector(handle: int, parameter: int, x: float, y: float, z: float) -> None:
    vector = float64_at(handle + 8 * AT.vector)
    vector[0], vector[1], vector[2] = x, z, -y
    call_void(int64_at(handle)[AT.set_doubles], (np.int32(parameter), handle + 8 * AT.vector))


@jit
def _switch_motors(handle: int, on: bool) -> None:
    """Switch the motors on or off if their state differs; the library reports the result."""
    word = int64_at(handle)
    if word[AT.output] != int(on):
        call_void(word[AT.enable] if on else word[AT.disable], (np.int32(hd.FORCE_OUTPUT),))
        word[AT.output] = call_int32(word[AT.is_enabled], (np.int32(hd.FORCE_OUTPUT),)) & 0xFF


@jit
def _send_wrench(handle: int, wrench: Any) -> None:
    """Send the servo's last complete wrench to the device, or zero."""
    word = int64_at(handle)
    now = read_monotonic_ns(handle + 8 * AT.frame_timespec)
    word[AT.late] = int(now - word[AT.framed_at] > word[AT.age_max])
    word[AT.framed_at] = now
    may_send = word[AT.armed] != 0 and word[AT.stopped] == 0 and word[AT.is_leaving] == 0 and word[AT.status] == OK
    is_current = wrench[KNOWN_LAPSES] == word[AT.lapses]
    is_usable = may_send and is_current and word[AT.docked] == 0 and word[AT.late] == 0
    is_usable = is_usable and now - word[AT.started_at] - wrench[WRITE_TIME] <= word[AT.age_max]
    has_force = not is_zero(wrench, 6)
    if not is_usable and (word[AT.has_force] != 0 or (has_force and is_current)):
        word[AT.lapses] += 1
    word[AT.has_force] = int(is_usable and has_force)
    share = 1.0 if is_usable else 0.0
    _send_vector(handle, hd.CURRENT_FORCE, share * wrench[0], share * wrench[1], share * wrench[2])
    if word[AT.has_torque] != 0:
        share *= MNM_PER_NM
        _send_vector(handle, hd.CURRENT_TORQUE, share * wrench[3], share * wrench[4], share * wrench[5])
    _switch_motors(handle, may_send)


@jit
def _make_pose(handle: int) -> Any:
    """Return the frame's pose in the world frame; the orientation is NaN if its matrix is not a rotation."""
    word, new_pose = int64_at(handle), float64_array_at(handle + 8 * AT.new_pose, SAMPLE_SIZE)
    p, m = float64_at(handle + 8 * AT.position), float64_at(handle + 8 * AT.matrix)
    rows = ((m[0], -m[8], m[4]), (-m[2], m[10], -m[6]), (m[1], -m[9], m[5]))
    store_pose(new_pose, (p[0] / MM_PER_M, -p[2] / MM_PER_M, p[1] / MM_PER_M), convert_matrix(rows))
    new_pose[SAMPLE_TIME] = (word[AT.framed_at] - word[AT.started_at]) / NS_PER_S
    new_pose[SAMPLE_BUTTONS] = float(np.int64(int32_at(handle + 8 * AT.buttons)[0]) & 0xFFFFFFFF)
    return new_pose


@c_function(types.uint32(types.int64))
def run_frame(handle: int) -> int:
    """Run a frame; the library's thread calls it."""
    word = int64_at(handle)
    if word[AT.open] == 0:
        return DONE
    device = (np.int32(word[AT.device]),)
    # Read before the frame: `has_left` and `has_sent_zero` report that a complete frame followed.
    leaving, stopping = word[AT.is_leaving], word[AT.stopped]
    call_void(word[AT.begin_frame], device)
    _read_state(handle)
    word[AT.docked] = int(word[AT.has_inkwell] != 0 and uint8_at(handle + 8 * AT.switch)[0] == 0)
    _send_wrench(handle, _read_wrench(handle))
    call_void(word[AT.end_frame], device)
    _store_errors(handle)
    if word[AT.status] == OK:
        store(slot_at(handle + 8 * AT.pose, SAMPLE_SIZE), _make_pose(handle))
    word[AT.frames] += 1
    if stopping != 0:
        word[AT.has_sent_zero] = 1
    if leaving != 0:
        word[AT.has_left] = 1
        return DONE
    return CONTINUE


# --- the servo -------------------------------------------------------------------------------------


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    now = read_monotonic_ns(handle + 8 * AT.servo_timespec)
    elapsed = min(now - word[AT.read_at], SILENCE_STEP_MAX_NS)
    word[AT.read_at] = now
    if word[AT.open] == 0:
        return LOST
    if word[AT.status] < 0:
        return int(word[AT.status])
    pose, last_sample = float64_array_at(handle + 8 * AT.read_pose, SAMPLE_SIZE), float64_at(handle + 8 * AT.sample)
    sequence = refresh(slot_at(handle + 8 * AT.pose, SAMPLE_SIZE), word[AT.pose_seen], pose)
    word[AT.reads] += 1
    status = OK
    if sequence != word[AT.pose_seen]:
        word[AT.pose_seen], word[AT.silence] = sequence, 0
        copy_sample(pose, last_sample)
    else:
        word[AT.repeated] += 1
        word[AT.silence] += elapsed
        if word[AT.silence] > TIMEOUT_NS:
            return TIMEOUT
        status = STALE
    copy_sample(last_sample, sample)
    return status


@jit
def _find_write_status(handle: int, wrench: Any, now: int) -> int:
    """Return OK if the library's thread will send the wrench, WITHHELD or HELD if not.

    WITHHELD: it sends zero instead. HELD: its frames have stopped, so the motors keep their force.
    """
    word = int64_at(handle)
    lapsed = word[AT.lapses] != word[AT.known_lapses]
    word[AT.known_lapses] = word[AT.lapses]
    silent = now - word[AT.framed_at] > word[AT.age_max]
    if silent and word[AT.has_force] != 0 and word[AT.stopped] == 0:
        return HELD
    if is_zero(wrench, 6):
        return OK
    is_usable = is_finite(wrench, 6) and word[AT.armed] != 0 and word[AT.stopped] == 0
    if lapsed or silent or not is_usable or word[AT.docked] != 0 or word[AT.late] != 0:
        return WITHHELD
    return OK


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    word, new_wrench = int64_at(handle), float64_array_at(handle + 8 * AT.new_wrench, WRENCH_SIZE)
    now = read_monotonic_ns(handle + 8 * AT.servo_timespec)
    status = _find_write_status(handle, wrench, now)
    for k in range(6):
        new_wrench[k] = wrench[k] if status == OK else 0.0
    new_wrench[WRITE_TIME] = float(now - word[AT.started_at])
    new_wrench[KNOWN_LAPSES] = float(word[AT.known_lapses])
    store(slot_at(handle + 8 * AT.wrench, WRENCH_SIZE), new_wrench)
    word[AT.writes] += 1
    return status
