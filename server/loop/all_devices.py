"""The devices' side of a tick: reading all, writing all, what each says of it, and the last zero.

A device for each finger, in the order of the scene's fingers. With one of them nothing of that order is left once it
is compiled.
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
from softfinger.proxy.kernels.jit.tuples import fold_each
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.record import AT
from softfinger.server.loop import shutdown
from softfinger.server.loop.guard import POSE_JUMPED, POSE_REFUSED, Guard
from softfinger.server.loop.inputs.poses import doubt, nothing_seen
from softfinger.server.loop.tick import FingerMemory, elsewhere, held, let_go, record_wrench

NOT_TAKEN: Final = POSE_REFUSED | POSE_JUMPED
"""Bits of a pose without which a run may end."""


class Io(NamedTuple):
    """Functions and handle of a device (drivers.base)."""

    read: int
    write: int
    handle: int


class Line(NamedTuple):
    """Memory for one device.

    raw     what it said
    offset  (3,) m  what was added to its position in the last tick
    sample  what it said, with that
    wrench  what it is written
    record  its finger's part of the tick's record
    held    (2,)   ticks in a row whose wrench it has not taken, and how many may be
    seen    memory of what its poses were (server.loop.inputs.poses)
    doubt   (1,)   the guard's bit of what speaks against the pose of this tick, 0 if nothing does
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
    """What the loop says of a tick in the record of each finger, s; `missed` counts deadlines."""

    timestamp: float
    late: float
    exec: float
    missed: int
    busy: float


def make_line(record: NDArray[np.float64], held_max: int) -> Line:
    """Memory for a device whose finger's part of the record is given, and that may keep a force for so many ticks."""
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
    """A driver's status; one that no driver has is an answer that is not in its protocol."""
    return PROTOCOL if status > HELD else status


@jit
def put_wrench(wrench: NDArray[np.float64], force: Vec3, torque: Vec3) -> None:
    for i in range(3):
        wrench[i] = force[i]
        wrench[3 + i] = torque[i]


@jit
def read_one(
    io: Io, line: Any, guard: Guard, offset: Any, start: FingerMemory, hand: FingerMemory, dt: float
) -> tuple[FingerMemory, int]:
    """Read a sample of a device, and add its offset; FingerMemory, as it is where a driver withholds the force or the
    offset is another one, and status. A pose that is not believed becomes none.

    dt  s  since the last read
    """
    # Not into the sample: a driver that has nothing new may leave what it gave before.
    status = known(call_device(io.read, io.handle, line.raw))
    if status == WITHHELD:
        hand = let_go(start, hand)
    for i in range(SAMPLE_SIZE):
        line.sample[i] = line.raw[i]
    moved = False
    for i in range(3):
        line.sample[i] += offset[i]
        moved |= offset[i] != line.offset[i]
        line.offset[i] = offset[i]
    if moved:
        hand = elsewhere(start, hand)
    line.doubt[0] = doubt(guard, line.seen, line.raw, status, hand.guarded.force, dt)
    if line.doubt[0] != 0:
        line.sample[0] = np.nan
    return hand, status


@jit
def write_one(
    io: Io, line: Any, tool: Any, start: FingerMemory, before: FingerMemory, hand: FingerMemory
) -> tuple[FingerMemory, int]:
    """Write a device its wrench; FingerMemory and record, which go by what the hand feels, and status.

    before  the FingerMemory of the tick before
    """
    put_wrench(line.wrench, hand.guarded.force, hand.guarded.torque)
    status = known(call_device(io.write, io.handle, line.wrench))
    line.held[0] = line.held[0] + 1 if status == HELD else 0
    if line.held[0] > line.held[1]:
        status = TIMEOUT
    if status in (WITHHELD, HELD):
        hand = let_go(start, hand) if status == WITHHELD else held(before.guarded, hand)
        record_wrench(tool, hand.guarded, line.record)
    return hand, status


@jit
def ended(statuses: Any) -> tuple[int, int]:
    """The first device that gives no more, -1 where all do, and its status; else the first one's status."""
    return fold_each(first_ended, statuses, (-1, 0))


@jit
def first_ended(status: int, others: tuple[int, int]) -> tuple[int, int]:
    """The same of a device and those behind it."""
    gives_no_more = status < 0 or status == END
    if gives_no_more or others[0] < 0:
        return (0 if gives_no_more else -1), status
    return others[0] + 1, others[1]


@jit
def stamp_one(line: Any, status_in: int, status_out: int, stamp: Stamp) -> None:
    """Fill the loop's and the device's part of a record."""
    record, sample = line.record, line.sample
    record[AT.timestamp] = stamp.timestamp
    record[AT.servo_late] = stamp.late
    record[AT.servo_exec] = stamp.exec
    record[AT.servo_missed] = stamp.missed
    record[AT.servo_busy] = stamp.busy
    record[AT.servo_device] = max(status_in, status_out)
    record[AT.buttons] = sample[SAMPLE_BUTTONS]
    record[AT.gripper] = sample[SAMPLE_GRIPPER]
    if line.doubt[0] != 0:
        record[AT.servo_guard] = line.doubt[0]


@jit
def guarded_bits(lines: Any) -> tuple[int, int]:
    """Bits of the guards in this tick, all together, and the first finger whose pose was not taken, 0 if all were."""
    return fold_each(bits_of, lines, (0, 0))


@jit
def bits_of(line: Any, others: tuple[int, int]) -> tuple[int, int]:
    """The same of a finger and those behind it."""
    own, (bits, place) = int(line.record[AT.servo_guard]), others
    return own | bits, 0 if own & NOT_TAKEN or not bits & NOT_TAKEN else place + 1


@jit
def write_zero_to(io: Io, line: Any) -> None:
    """The last act of every loop, whatever ended it; nobody is left to act on a status."""
    shutdown.write_zero(io.write, io.handle, line.wrench)
