"""The servo's loop: one nopython function, from the reads of the devices to their writes.

It takes no GIL, allocates nothing and waits for nobody. It shares with Python: a stop word, a slot of parameters, a
ring of records and an eventfd that tells the reader a record is there. `servo_thread.py` runs it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.drivers.base import END
from softfinger.proxy.kernels.jit.atomics import load_acquire, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.pack import unpack
from softfinger.proxy.kernels.jit.seqlock import Slot, refresh
from softfinger.proxy.kernels.jit.tuples import field_of_each, map_each, unzip
from softfinger.server.loop.all_devices import (
    Io,
    Line,
    Stamp,
    ended,
    guarded_bits,
    read_one,
    stamp_one,
    write_one,
    write_zero_to,
)
from softfinger.server.loop.bodies import move_bodies
from softfinger.server.loop.clock import NS_PER_S, Pace, first_pace, next_pace, now_ns, sleep_until, with_suspension
from softfinger.server.loop.health import HEALTHY, examine
from softfinger.server.loop.inputs.ramp import Way, advance, head_for, stay
from softfinger.server.loop.shared.ring import Ring, push
from softfinger.server.loop.shutdown import FINISHED, READ_FAILED, STOPPED, WRITE_FAILED
from softfinger.server.loop.tick import Memory, Tuning, tick

_eventfd_write = types.ExternalFunction("eventfd_write", types.int32(types.int32, types.uint64))


class Schedule(NamedTuple):
    """Period and epoch offset, ns; ticks to run, -1 for no end; whether all devices keep their own clock: then a tick
    takes a period, else what the wall clock says, for every finger."""

    period_ns: int
    epoch_ns: int
    ticks: int
    own_clock: int


class Shared(NamedTuple):
    """Memory the loop shares with Python: stop word, ticks and misses so far, of the loops before it too, and whether
    it was woken late when it ended for want of time, parameter slot, ring of records, eventfd that wakes its reader,
    slot of the motion of bodies (query.bodies). The ring has a row a tick: the records of all fingers, one after the
    other."""

    stop: NDArray[np.int64]
    progress: NDArray[np.int64]
    tuning: Slot
    ring: Ring
    wake_fd: int
    motion: Slot


class Scratch(NamedTuple):
    """Memory of the loop alone, allocated before it starts: a Line for each device, its record a part of `row`; the way
    from the parameters of now to those that are wanted."""

    timespec: NDArray[np.int64]
    values: NDArray[np.float64]
    row: NDArray[np.float64]
    lines: tuple[Line, ...]
    way: Way
    motion: NDArray[np.float64]


@jit
def newest_parameters(
    slot: Slot, seen: int, values: NDArray[np.float64], way: Way, tuning: Tuning
) -> tuple[int, Tuning]:
    """The parameters of this tick, on their way to the newest that are wanted, and the version of those."""
    newest = refresh(slot, seen, values)
    if newest != seen:
        head_for(way, values)
    if way.left[0] > 0:
        advance(way)
        tuning = unpack(tuning, way.now)
    return newest, tuning


@jit
def stamp_of(schedule: Schedule, pace: Pace, woke: int, wrote: int, busy: int) -> Stamp:
    """The loop's part of a record: when it was due, began and was written, ns; `busy` is of the tick before."""
    return Stamp(
        timestamp=(woke + schedule.epoch_ns) / NS_PER_S,
        late=(woke - pace.deadline) / NS_PER_S,
        exec=(wrote - woke) / NS_PER_S,
        missed=pace.missed,
        busy=busy / NS_PER_S,
    )


@jit
def hand_over_record(shared: Shared, row: NDArray[np.float64], ticks: int) -> None:
    """Give a tick's records to their reader, and wake it; `ticks` are done with this one."""
    push(shared.ring, row)
    store_release(shared.progress, 0, ticks)
    _eventfd_write(shared.wake_fd, 1)


@entry
def servo_loop(
    tuning_like: Tuning, start: Memory, ios: tuple[Io, ...], schedule: Schedule, shared: Shared, scratch: Scratch
) -> tuple[int, int, int]:
    """Run ticks until told to stop; returns how it ended, the last status of a device, and which finger's that is.

    Ticks and misses go on from those in `shared`.
    Whatever the end, the last thing written to every device is zero.
    """
    timespec, lines = scratch.timespec, scratch.lines
    samples, records = field_of_each(lines, "sample"), field_of_each(lines, "record")
    seen = refresh(shared.tuning, -1, scratch.values)
    stay(scratch.way, scratch.values)
    tuning, memory, health = unpack(tuning_like, scratch.way.now), start, HEALTHY
    nominal = schedule.period_ns / NS_PER_S
    number, busy, ending, status, finger = load_acquire(shared.progress, 0), 0, STOPPED, 0, 0
    pace = first_pace(now_ns(timespec), schedule.period_ns, load_acquire(shared.progress, 1), timespec)

    while load_acquire(shared.stop, 0) == 0:
        if number == schedule.ticks:
            ending = FINISHED
            break
        sleep_until(pace.deadline, timespec)
        woke = now_ns(timespec)
        pace = with_suspension(pace, woke, timespec)
        dt = nominal if schedule.own_clock else pace.dt

        seen, tuning = newest_parameters(shared.tuning, seen, scratch.values, scratch.way, tuning)
        befores, statuses = unzip(
            map_each(read_one, (ios, lines, tuning.guards, tuning.offsets, start.fingers, memory.fingers), dt)
        )
        place, status = ended(statuses)
        if place >= 0:
            ending, finger = FINISHED if status == END else READ_FAILED, place
            break
        memory = Memory(memory.world, befores)
        memory = tick(tuning, start, memory, samples, dt, nominal, number, records)
        hands, statuses_out = unzip(
            map_each(write_one, (ios, lines, tuning.tools, start.fingers, befores, memory.fingers))
        )
        wrote = now_ns(timespec)
        move_bodies(tuning.scene.bodies, number, wrote, shared.motion, scratch.motion, timespec)
        place, status_out = ended(statuses_out)
        if place >= 0:
            ending, status, finger = WRITE_FAILED, status_out, place
            break
        memory = Memory(memory.world, hands)

        stamp = stamp_of(schedule, pace, woke, wrote, busy)
        map_each(stamp_one, (lines, statuses, statuses_out), stamp)
        number += 1
        hand_over_record(shared, scratch.row, number)

        done = now_ns(timespec)
        busy = done - woke
        pace = next_pace(pace, done, schedule.period_ns)
        store_release(shared.progress, 1, pace.missed)
        bits, place = guarded_bits(lines)
        health, fault = examine(health, bits, stamp.late, nominal if schedule.own_clock else pace.dt, nominal)
        if fault != 0:
            ending, finger = fault, place
            store_release(shared.progress, 2, int(health.late > 0.5 * health.lost))
            break

    map_each(write_zero_to, (ios, lines))
    return ending, status, finger
