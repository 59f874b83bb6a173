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
from softfinger.server.loop.inputs.poses import doubt, nothing_seen
from softfinger.server.loop.tick import elsewhere, held, let_go, record_wrench

NOT_TAKEN: Final = POSE_REFUSED | POSE_JUMPED
"""Bits of a pose that a run tolerates only for a limited time."""


class Io(NamedTuple):
    """Functions and handle of a device (drivers.base)."""

    read: int
    write: int
    handle: int


class Line(NamedTuple):
    """Buffers of one device.

    raw     sample from the driver
    offset  (3,) m  offset added to its position in the last tick
    sample  `raw` with the offset
    wrench  wrench to write
    record  its finger's part of the tick's record
    held    (2,)   number of successive ticks in which it ignored the wrench, and the largest number allowed
    seen    memory of its poses (server.loop.inputs.poses)
    doubt   (1,)   the guard's bit for an implausible pose in this tick, otherwise 0
    """

    raw: NDArray[np.float64]
    offset: NDArray[np.float64]
    sample: NDArray[np.float64]
    wrench: NDArray[np.float64]
    record: NDArray[np.float64]
    held: NDArray[np.int64]
    seen: NDArray[np.float64]
    doubt: NDArray[np.int64]


class Stamp(NamedTuple):
    """The loop's entries in the record of each finger, s; `missed` counts deadlines."""

    timestamp: float
    late: float
    exec: float
    missed: int
    busy: float


def make_line(record: NDArray[np.float64], held_max: int) -> Line:
    """Return the buffers of a device.

    record    its finger's part of the record
    held_max  number of ticks for which it may keep a force
    """
    held = np.array([0, held_max], np.int64)
    return Line(
        np.zeros(SAMPLE_SIZE),
        np.zeros(3),
        np.zeros(SAMPLE_SIZE),
        np.zeros(6),
        record,
        held,
        nothing_seen(),
        np.zeros(1, np.int64),
    )


@jit
def known(status: int) -> int:
    """Return a driver's status; an unknown one counts as a protocol error."""
    return PROTOCOL if status > HELD else status


@jit
def put_wrench(wrench: NDArray[np.float64], force: Vec3, torque: Vec3) -> None:
    for i in range(3):
        wrench[i] = force[i]
        wrench[3 + i] = torque[i]


@by_count
def samples_of(lines: Any) -> Any:
    """Return the samples of all devices, a tuple."""


@samples_of.of(1)
def sample_of_one(lines: Any) -> Any:
    return (lines[0].sample,)


@samples_of.of(2)
def samples_of_several(lines: Any) -> Any:
    # numba joins tuples of known types, and does not unpack one inside another.
    return (lines[0].sample,) + samples_of(lines[1:])  # noqa: RUF005


@by_count
def records_of(lines: Any) -> Any:
    """Return the records of all devices, a tuple."""


@records_of.of(1)
def record_of_one(lines: Any) -> Any:
    return (lines[0].record,)


@records_of.of(2)
def records_of_several(lines: Any) -> Any:
    return (lines[0].record,) + records_of(lines[1:])  # noqa: RUF005  # see above


@by_count
def read_all(ios: Any, lines: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    """Read a sample of every device and add its offset; return the FingerMemories and the statuses.

    dt  s  since the last read

    A FingerMemory changes if a driver withholds the force or the offset changes. The position of an implausible pose
    becomes nan.
    """


@read_all.of(1)
def read_one(ios: Any, lines: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    line, offset, hand = lines[0], offsets[0], hands[0]
    # Not into the sample: a driver without new data may leave the buffer as it is.
    status = known(call_device(ios[0].read, ios[0].handle, line.raw))
    if status == WITHHELD:
        hand = let_go(starts[0], hand)
    for i in range(SAMPLE_SIZE):
        line.sample[i] = line.raw[i]
    moved = False
    for i in range(3):
        line.sample[i] += offset[i]
        moved |= offset[i] != line.offset[i]
        line.offset[i] = offset[i]
    if moved:
        hand = elsewhere(starts[0], hand)
    line.doubt[0] = doubt(guards[0], line.seen, line.raw, status, hand.guarded.force, dt)
    if line.doubt[0] != 0:
        line.sample[0] = np.nan
    return (hand,), (status,)


@read_all.of(2)
def read_several(ios: Any, lines: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    hand, status = read_all(ios[:1], lines[:1], guards[:1], offsets[:1], starts[:1], hands[:1], dt)
    others, statuses = read_all(ios[1:], lines[1:], guards[1:], offsets[1:], starts[1:], hands[1:], dt)
    return hand + others, status + statuses


@by_count
def write_all(ios: Any, lines: Any, tools: Any, starts: Any, befores: Any, hands: Any) -> Any:
    """Write a wrench to every device; return the FingerMemories and the statuses.

    befores  FingerMemories of the previous tick

    FingerMemories and records follow the force that each hand receives.
    """


@write_all.of(1)
def write_one(ios: Any, lines: Any, tools: Any, starts: Any, befores: Any, hands: Any) -> Any:
    line, hand = lines[0], hands[0]
    put_wrench(line.wrench, hand.guarded.force, hand.guarded.torque)
    status = known(call_device(ios[0].write, ios[0].handle, line.wrench))
    line.held[0] = line.held[0] + 1 if status == HELD else 0
    if line.held[0] > line.held[1]:
        status = TIMEOUT
    if status in (WITHHELD, HELD):
        hand = let_go(starts[0], hand) if status == WITHHELD else held(befores[0].guarded, hand)
        record_wrench(tools[0], hand.guarded, line.record)
    return (hand,), (status,)


@write_all.of(2)
def write_several(ios: Any, lines: Any, tools: Any, starts: Any, befores: Any, hands: Any) -> Any:
    hand, status = write_all(ios[:1], lines[:1], tools[:1], starts[:1], befores[:1], hands[:1])
    others, statuses = write_all(ios[1:], lines[1:], tools[1:], starts[1:], befores[1:], hands[1:])
    return hand + others, status + statuses


@by_count
def ended(statuses: Any) -> Any:
    """Return the index of the first device that failed or finished, -1 if there is none, and its status.

    Without one, the status is that of the first device.
    """


@ended.of(1)
def one_ended(statuses: Any) -> tuple[int, int]:
    return (0 if statuses[0] < 0 or statuses[0] == END else -1), statuses[0]


@ended.of(2)
def any_ended(statuses: Any) -> tuple[int, int]:
    place, status = ended(statuses[1:])
    if place < 0 or statuses[0] < 0 or statuses[0] == END:
        return ended(statuses[:1])
    return place + 1, status


@by_count
def stamp_all(lines: Any, stamp: Stamp, statuses_in: Any, statuses_out: Any) -> None:
    """Fill the loop's and the device's part of every record."""


@stamp_all.of(1)
def stamp_one(lines: Any, stamp: Stamp, statuses_in: Any, statuses_out: Any) -> None:
    record, sample = lines[0].record, lines[0].sample
    record[AT.timestamp] = stamp.timestamp
    record[AT.servo_late] = stamp.late
    record[AT.servo_exec] = stamp.exec
    record[AT.servo_missed] = stamp.missed
    record[AT.servo_busy] = stamp.busy
    record[AT.servo_device] = max(statuses_in[0], statuses_out[0])
    record[AT.buttons] = sample[SAMPLE_BUTTONS]
    record[AT.gripper] = sample[SAMPLE_GRIPPER]
    if lines[0].doubt[0] != 0:
        record[AT.servo_guard] = lines[0].doubt[0]


@stamp_all.of(2)
def stamp_several(lines: Any, stamp: Stamp, statuses_in: Any, statuses_out: Any) -> None:
    stamp_all(lines[:1], stamp, statuses_in[:1], statuses_out[:1])
    stamp_all(lines[1:], stamp, statuses_in[1:], statuses_out[1:])


@by_count
def guarded_bits(lines: Any) -> Any:
    """Return the bits of all guards combined, and the first finger with a rejected pose, 0 if there is none."""


@guarded_bits.of(1)
def bits_of_one(lines: Any) -> tuple[int, int]:
    return int(lines[0].record[AT.servo_guard]), 0


@guarded_bits.of(2)
def bits_of_several(lines: Any) -> tuple[int, int]:
    own, _ = guarded_bits(lines[:1])
    bits, place = guarded_bits(lines[1:])
    return own | bits, 0 if own & NOT_TAKEN or not bits & NOT_TAKEN else place + 1


@by_count
def write_zeros(ios: Any, lines: Any) -> None:
    """Write zero to every device, the last act of every loop; statuses are ignored."""


@write_zeros.of(1)
def write_zero_to_one(ios: Any, lines: Any) -> None:
    shutdown.write_zero(ios[0].write, ios[0].handle, lines[0].wrench)


@write_zeros.of(2)
def write_zero_to_several(ios: Any, lines: Any) -> None:
    write_zeros(ios[:1], lines[:1])
    write_zeros(ios[1:], lines[1:])
