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
from softfinger.proxy.kernels.jit.dispatch import by_count
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.record import AT
from softfinger.server.loop import shutdown
from softfinger.server.loop.guard import POSE_JUMPED, POSE_REFUSED
from softfinger.server.loop.inputs.poses import doubt, nothing_seen
from softfinger.server.loop.tick import elsewhere, held, let_go, record_wrench

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


@by_count
def samples_of(lines: Any) -> Any:
    """Every sample, as a tuple."""


@samples_of.of(1)
def sample_of_one(lines: Any) -> Any:
    return (lines[0].sample,)


@samples_of.of(2)
def samples_of_several(lines: Any) -> Any:
    # numba joins tuples of known types, and does not unpack one inside another.
    return (lines[0].sample,) + samples_of(lines[1:])  # noqa: RUF005


@by_count
def records_of(lines: Any) -> Any:
    """Every record, as a tuple."""


@records_of.of(1)
def record_of_one(lines: Any) -> Any:
    return (lines[0].record,)


@records_of.of(2)
def records_of_several(lines: Any) -> Any:
    return (lines[0].record,) + records_of(lines[1:])  # noqa: RUF005  # see above


@by_count
def read_all(ios: Any, lines: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    """Read a sample of every device, and add its offset; FingerMemories, as they are where a driver withholds the force
    or the offset is another one, and statuses. A pose that is not believed becomes none.

    dt  s  since the last read
    """


@read_all.of(1)
def read_one(ios: Any, lines: Any, guards: Any, offsets: Any, starts: Any, hands: Any, dt: float) -> Any:
    line, offset, hand = lines[0], offsets[0], hands[0]
    # Not into the sample: a driver that has nothing new may leave what it gave before.
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
    """Write every device its wrench; FingerMemories and records, which go by what each hand feels, and statuses.

    befores  the FingerMemories of the tick before
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
    """The first device that gives no more, -1 where all do, and its status; else the first one's status."""


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
    """Bits of the guards in this tick, all together, and the first finger whose pose was not taken, 0 if all were."""


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
    """The last act of every loop, whatever ended it; nobody is left to act on a status."""


@write_zeros.of(1)
def write_zero_to_one(ios: Any, lines: Any) -> None:
    shutdown.write_zero(ios[0].write, ios[0].handle, lines[0].wrench)


@write_zeros.of(2)
def write_zero_to_several(ios: Any, lines: Any) -> None:
    write_zeros(ios[:1], lines[:1])
    write_zeros(ios[1:], lines[1:])
