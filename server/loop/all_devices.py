"""Device I/O of a tick: reads, writes, statuses and the last zero, for the devices of all fingers.

There is a device for each finger, in the order of the scene's fingers. `fold_each` calls the kernels of one device for
each of them.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.drivers.base import (
    END,
    HELD,
    PROTOCOL,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_SIZE,
    TIMEOUT,
    WITHHELD,
    DeviceIO,
)
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import fold_each
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.record import AT
from softfinger.server.loop import shutdown
from softfinger.server.loop.guard import POSE_JUMPED, POSE_REFUSED, Guard
from softfinger.server.loop.plausibility import check_pose, make_pose_memory
from softfinger.server.loop.tick import FingerMemory, continue_from_wrench, record_wrench, reset_contact, reset_guard

POSE_REJECTED: Final = POSE_REFUSED | POSE_JUMPED
"""Bits of a pose that a run tolerates only for a limited time."""


class DeviceBuffers(NamedTuple):
    """Buffers of one device.

    raw            sample from the driver
    offset         (3,) m  offset added to its position in the last tick
    sample         `raw` with the offset
    wrench         wrench to write
    record         its finger's part of the tick's record
    ignored_ticks  (2,)   number of successive ticks in which it ignored the wrench, and the largest number allowed
    pose_memory    memory of its poses (server.loop.plausibility)
    pose_fault     (1,)   the guard's bit for an implausible pose in this tick, otherwise 0
    failed         (1,)   1 if it failed in this tick, otherwise 0
    """

    raw: NDArray[np.float64]
    offset: NDArray[np.float64]
    sample: NDArray[np.float64]
    wrench: NDArray[np.float64]
    record: NDArray[np.float64]
    ignored_ticks: NDArray[np.int64]
    pose_memory: NDArray[np.float64]
    pose_fault: NDArray[np.int64]
    failed: NDArray[np.int64]


class Stamp(NamedTuple):
    """The loop's entries in the record of each finger, s; `missed` counts deadlines."""

    timestamp: float
    late: float
    exec: float
    missed: int
    busy: float


def make_device_buffers(record: NDArray[np.float64], max_ignored_ticks: int) -> DeviceBuffers:
    """Return the buffers of a device.

    record             its finger's part of the record
    max_ignored_ticks  number of ticks for which it may keep a force
    """
    ignored_ticks = np.array([0, max_ignored_ticks], np.int64)
    return DeviceBuffers(
        np.zeros(SAMPLE_SIZE),
        np.zeros(3),
        np.zeros(SAMPLE_SIZE),
        np.zeros(6),
        record,
        ignored_ticks,
        make_pose_memory(),
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
    )


@jit
def check_status(status: int) -> int:
    """Return a driver's status; an unknown one counts as a protocol error."""
    return PROTOCOL if status > HELD else status


@jit
def write_wrench(wrench: NDArray[np.float64], force: Vec3, torque: Vec3) -> None:
    for i in range(3):
        wrench[i] = force[i]
        wrench[3 + i] = torque[i]


@jit
def read_one(
    io: DeviceIO, device: Any, guard: Guard, offset: Any, start: FingerMemory, hand: FingerMemory, dt: float
) -> tuple[FingerMemory, int]:
    """Read a sample of a device and add its offset; return the finger's memory and the status.

    dt  s  since the last read

    The memory changes if the driver withholds the force or the offset changes. The position of an implausible pose
    becomes nan.
    """
    # `raw` keeps the sample without the offset: a driver without new data may leave it as it is.
    status = check_status(call_device(io.read, io.handle, device.raw))
    device.failed[0] = int(status < 0)
    if status == WITHHELD:
        hand = reset_guard(start, hand)
    for i in range(SAMPLE_SIZE):
        device.sample[i] = device.raw[i]
    has_moved = False
    for i in range(3):
        device.sample[i] += offset[i]
        has_moved |= offset[i] != device.offset[i]
        device.offset[i] = offset[i]
    if has_moved:
        hand = reset_contact(start, hand)
    device.pose_fault[0] = check_pose(guard, device.pose_memory, device.raw, status, hand.guard_state.force, dt)
    if device.pose_fault[0] != 0:
        device.sample[0] = np.nan
    return hand, status


@jit
def write_one(
    io: DeviceIO, device: Any, tool: Any, start: FingerMemory, before: FingerMemory, hand: FingerMemory
) -> tuple[FingerMemory, int]:
    """Write a wrench to a device; return the finger's memory and the status.

    before  the finger's memory of the previous tick

    Memory and record have the force that the hand receives.
    """
    write_wrench(device.wrench, hand.guard_state.force, hand.guard_state.torque)
    status = check_status(call_device(io.write, io.handle, device.wrench))
    device.ignored_ticks[0] = device.ignored_ticks[0] + 1 if status == HELD else 0
    if device.ignored_ticks[0] > device.ignored_ticks[1]:
        status = TIMEOUT
    device.failed[0] = int(status < 0)
    if status in (WITHHELD, HELD):
        hand = reset_guard(start, hand) if status == WITHHELD else continue_from_wrench(before.guard_state, hand)
        record_wrench(tool, hand.guard_state, device.record)
    return hand, status


@jit
def find_first_ended(statuses: Any) -> tuple[int, int]:
    """Return the index of the first device that failed or finished, -1 if there is none, and its status.

    Without one, the status is that of the first device.
    """
    return fold_each(pick_first_ended, statuses, (-1, 0))


@jit
def pick_first_ended(status: int, later: tuple[int, int]) -> tuple[int, int]:
    """Combine the status of a device with the result of `find_first_ended` for the devices after it."""
    has_ended = status < 0 or status == END
    if has_ended or later[0] < 0:
        return (0 if has_ended else -1), status
    return later[0] + 1, later[1]


@jit
def stamp_one(device: Any, status_in: int, status_out: int, stamp: Stamp) -> None:
    """Fill the loop's and the device's part of a record."""
    record, sample = device.record, device.sample
    record[AT.timestamp] = stamp.timestamp
    record[AT.servo_late] = stamp.late
    record[AT.servo_exec] = stamp.exec
    record[AT.servo_missed] = stamp.missed
    record[AT.servo_busy] = stamp.busy
    record[AT.servo_device] = max(status_in, status_out)
    record[AT.buttons] = sample[SAMPLE_BUTTONS]
    record[AT.gripper] = sample[SAMPLE_GRIPPER]
    if device.pose_fault[0] != 0:
        record[AT.servo_guard] = device.pose_fault[0]


@jit
def collect_guard_bits(buffers: Any) -> tuple[int, int]:
    """Return the bits of all guards combined, and the first finger with a rejected pose, 0 if there is none."""
    return fold_each(add_guard_bits, buffers, (0, 0))


@jit
def add_guard_bits(device: Any, later: tuple[int, int]) -> tuple[int, int]:
    """Combine the bits of a finger with the result of `collect_guard_bits` for the fingers after it."""
    bits_of_device, (bits, index) = int(device.record[AT.servo_guard]), later
    return bits_of_device | bits, 0 if bits_of_device & POSE_REJECTED or not bits & POSE_REJECTED else index + 1


@jit
def write_zero_to(io: DeviceIO, device: Any, failed: int) -> None:
    """Write zero to a device with this value of `failed`; the status is ignored."""
    if device.failed[0] == failed:
        shutdown.write_zero(io.write, io.handle, device.wrench)
