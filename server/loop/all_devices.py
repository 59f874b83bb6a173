"""Device I/O of a tick: reads, writes, statuses and the last zero, for the devices of all fingers.

There is a device for each finger, in the order of the scene's fingers. The recursion over fingers is resolved during
compilation.
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
)
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_count
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.record import AT
from softfinger.server.loop import shutdown
from softfinger.server.loop.guard import POSE_JUMPED, POSE_REFUSED
from softfinger.server.loop.inputs.poses import check_pose, make_pose_memory
from softfinger.server.loop.tick import record_wrench, reset_contact, reset_guard, with_kept_wrench

POSE_REJECTED: Final = POSE_REFUSED | POSE_JUMPED
"""Bits of a pose that a run tolerates only for a limited time."""


class Io(NamedTuple):
    """Functions and handle of a device (drivers.base)."""

    read: int
    write: int
    handle: int


class DeviceBuffers(NamedTuple):
    """Buffers of one device.

    raw            sample from the driver
    offset         (3,) m  offset added to its position in the last tick
    sample         `raw` with the offset
    wrench         wrench to write
    record         its finger's part of the tick's record
    ignored_ticks  (2,)   number of successive ticks in which it ignored the wrench, and the largest number allowed
    pose_memory    memory of its poses (server.loop.inputs.poses)
    pose_fault     (1,)   the guard's bit for an implausible pose in this tick, otherwise 0
    """

    raw: NDArray[np.float64]
    offset: NDArray[np.float64]
    sample: NDArray[np.float64]
    wrench: NDArray[np.float64]
    record: NDArray[np.float64]
    ignored_ticks: NDArray[np.int64]
    pose_memory: NDArray[np.float64]
    pose_fault: NDArray[np.int64]


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
    )


@jit
def checked_status(status: int) -> int:
    """Return a driver's status; an unknown one counts as a protocol error."""
    return PROTOCOL if status > HELD else status


@jit
def put_wrench(wrench: NDArray[np.float64], force: Vec3, torque: Vec3) -> None:
    for i in range(3):
        wrench[i] = force[i]
        wrench[3 + i] = torque[i]


@by_count
def samples_of(buffers: Any) -> Any:
    """Return the samples of all devices, a tuple."""


@samples_of.of(1)
def sample_of_one(buffers: Any) -> Any:
    return (buffers[0].sample,)


@samples_of.of(2)
def samples_of_several(buffers: Any) -> Any:
    # numba joins tuples of known types, and does not unpack one inside another.
    return (buffers[0].sample,) + samples_of(buffers[1:])  # noqa: RUF005


@by_count
def records_of(buffers: Any) -> Any:
    """Return the records of all devices, a tuple."""


@records_of.of(1)
def record_of_one(buffers: Any) -> Any:
    return (buffers[0].record,)


@records_of.of(2)
def records_of_several(buffers: Any) -> Any:
    return (buffers[0].record,) + records_of(buffers[1:])  # noqa: RUF005  # see above


@by_count
def read_all(ios: Any, buffers: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    """Read a sample of every device and add its offset; return the FingerMemories and the statuses.

    dt  s  since the last read

    A FingerMemory changes if a driver withholds the force or the offset changes. The position of an implausible pose
    becomes nan.
    """


@read_all.of(1)
def read_one(ios: Any, buffers: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    device, offset, hand = buffers[0], offsets[0], hands[0]
    # Not into the sample: a driver without new data may leave the buffer as it is.
    status = checked_status(call_device(ios[0].read, ios[0].handle, device.raw))
    if status == WITHHELD:
        hand = reset_guard(starts[0], hand)
    for i in range(SAMPLE_SIZE):
        device.sample[i] = device.raw[i]
    has_moved = False
    for i in range(3):
        device.sample[i] += offset[i]
        has_moved |= offset[i] != device.offset[i]
        device.offset[i] = offset[i]
    if has_moved:
        hand = reset_contact(starts[0], hand)
    device.pose_fault[0] = check_pose(guards[0], device.pose_memory, device.raw, status, hand.guard_state.force, dt)
    if device.pose_fault[0] != 0:
        device.sample[0] = np.nan
    return (hand,), (status,)


@read_all.of(2)
def read_several(ios: Any, buffers: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    hand, status = read_all(ios[:1], buffers[:1], guards[:1], offsets[:1], starts[:1], hands[:1], dt)
    others, statuses = read_all(ios[1:], buffers[1:], guards[1:], offsets[1:], starts[1:], hands[1:], dt)
    return hand + others, status + statuses


@by_count
def write_all(ios: Any, buffers: Any, tools: Any, starts: Any, befores: Any, hands: Any) -> Any:
    """Write a wrench to every device; return the FingerMemories and the statuses.

    befores  FingerMemories of the previous tick

    FingerMemories and records follow the force that each hand receives.
    """


@write_all.of(1)
def write_one(ios: Any, buffers: Any, tools: Any, starts: Any, befores: Any, hands: Any) -> Any:
    device, hand = buffers[0], hands[0]
    put_wrench(device.wrench, hand.guard_state.force, hand.guard_state.torque)
    status = checked_status(call_device(ios[0].write, ios[0].handle, device.wrench))
    device.ignored_ticks[0] = device.ignored_ticks[0] + 1 if status == HELD else 0
    if device.ignored_ticks[0] > device.ignored_ticks[1]:
        status = TIMEOUT
    if status in (WITHHELD, HELD):
        hand = reset_guard(starts[0], hand) if status == WITHHELD else with_kept_wrench(befores[0].guard_state, hand)
        record_wrench(tools[0], hand.guard_state, device.record)
    return (hand,), (status,)


@write_all.of(2)
def write_several(ios: Any, buffers: Any, tools: Any, starts: Any, befores: Any, hands: Any) -> Any:
    hand, status = write_all(ios[:1], buffers[:1], tools[:1], starts[:1], befores[:1], hands[:1])
    others, statuses = write_all(ios[1:], buffers[1:], tools[1:], starts[1:], befores[1:], hands[1:])
    return hand + others, status + statuses


@by_count
def first_ended(statuses: Any) -> Any:
    """Return the index of the first device that failed or finished, -1 if there is none, and its status.

    Without one, the status is that of the first device.
    """


@first_ended.of(1)
def first_ended_of_one(statuses: Any) -> tuple[int, int]:
    return (0 if statuses[0] < 0 or statuses[0] == END else -1), statuses[0]


@first_ended.of(2)
def first_ended_of_several(statuses: Any) -> tuple[int, int]:
    index, status = first_ended(statuses[1:])
    if index < 0 or statuses[0] < 0 or statuses[0] == END:
        return first_ended(statuses[:1])
    return index + 1, status


@by_count
def stamp_all(buffers: Any, stamp: Stamp, statuses_in: Any, statuses_out: Any) -> None:
    """Fill the loop's and the device's part of every record."""


@stamp_all.of(1)
def stamp_one(buffers: Any, stamp: Stamp, statuses_in: Any, statuses_out: Any) -> None:
    record, sample = buffers[0].record, buffers[0].sample
    record[AT.timestamp] = stamp.timestamp
    record[AT.servo_late] = stamp.late
    record[AT.servo_exec] = stamp.exec
    record[AT.servo_missed] = stamp.missed
    record[AT.servo_busy] = stamp.busy
    record[AT.servo_device] = max(statuses_in[0], statuses_out[0])
    record[AT.buttons] = sample[SAMPLE_BUTTONS]
    record[AT.gripper] = sample[SAMPLE_GRIPPER]
    if buffers[0].pose_fault[0] != 0:
        record[AT.servo_guard] = buffers[0].pose_fault[0]


@stamp_all.of(2)
def stamp_several(buffers: Any, stamp: Stamp, statuses_in: Any, statuses_out: Any) -> None:
    stamp_all(buffers[:1], stamp, statuses_in[:1], statuses_out[:1])
    stamp_all(buffers[1:], stamp, statuses_in[1:], statuses_out[1:])


@by_count
def guarded_bits(buffers: Any) -> Any:
    """Return the bits of all guards combined, and the first finger with a rejected pose, 0 if there is none."""


@guarded_bits.of(1)
def bits_of_one(buffers: Any) -> tuple[int, int]:
    return int(buffers[0].record[AT.servo_guard]), 0


@guarded_bits.of(2)
def bits_of_several(buffers: Any) -> tuple[int, int]:
    own, _ = guarded_bits(buffers[:1])
    bits, index = guarded_bits(buffers[1:])
    return own | bits, 0 if own & POSE_REJECTED or not bits & POSE_REJECTED else index + 1


@by_count
def write_zeros(ios: Any, buffers: Any) -> None:
    """Write zero to every device, the last act of every loop; statuses are ignored."""


@write_zeros.of(1)
def write_zero_to_one(ios: Any, buffers: Any) -> None:
    shutdown.write_zero(ios[0].write, ios[0].handle, buffers[0].wrench)


@write_zeros.of(2)
def write_zero_to_several(ios: Any, buffers: Any) -> None:
    write_zeros(ios[:1], buffers[:1])
    write_zeros(ios[1:], buffers[1:])
