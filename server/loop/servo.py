"""Servo loop: one nopython function, from the reads of the devices to their writes, run by `servo_thread.py`.

It takes no GIL, allocates nothing and never waits for another thread. It shares with Python: a stop flag, the switch of
the force, a slot of parameters, a ring of records, and an eventfd that notifies the reader of a record.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.drivers.base import END, DeviceIO
from softfinger.proxy.kernels.jit.atomics import load_acquire, store_release
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.pack import unpack
from softfinger.proxy.kernels.jit.seqlock import Slot, refresh, store
from softfinger.proxy.kernels.jit.tuples import field_of_each, map_each, unzip
from softfinger.proxy.kernels.query.bodies import NO_FAULT, check_budget, step_bodies, write_motion
from softfinger.server.loop.all_devices import (
    DeviceBuffers,
    Stamp,
    collect_guard_bits,
    find_first_ended,
    read_one,
    stamp_one,
    write_one,
    write_zero_to,
)
from softfinger.server.loop.clock import (
    NS_PER_S,
    Pace,
    compute_next_pace,
    make_first_pace,
    read_clock_ns,
    sleep_until,
    with_suspension,
)
from softfinger.server.loop.eventfd import wake_eventfd
from softfinger.server.loop.fault_detection import NO_FAULT_TIMES, detect_fault
from softfinger.server.loop.force_switch import apply_switch, count_unreachable, is_on, store_active
from softfinger.server.loop.parameter_ramp import ParameterRamp, advance, set_now, set_target
from softfinger.server.loop.rings import Ring, push
from softfinger.server.loop.shutdown import FINISHED, READ_FAILED, STOPPED, WRITE_FAILED
from softfinger.server.loop.tick import Memory, Tuning, run_tick


@jit
def move_bodies(bodies: Any, tick: int, start_ns: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    """Call `step_bodies` and `check_budget`, and publish the motion; on a fault, the last published motion remains.

    start_ns  start of the step
    scratch   array of `write_motion`
    """
    if bodies is None:
        return
    if step_bodies(bodies) == NO_FAULT:
        check_budget(bodies, read_clock_ns(timespec) - start_ns)
        write_motion(bodies, tick, scratch)
        store(motion, scratch)


class Schedule(NamedTuple):
    """Timing of a loop.

    period_ns  length of a tick
    epoch_ns   offset of the epoch from monotonic time
    ticks      number of ticks to run, -1 without end
    own_clock  1 if all devices have their own clock: every tick then lasts a period, for all fingers; otherwise 0, and
               its length is measured
    """

    period_ns: int
    epoch_ns: int
    ticks: int
    own_clock: int


class SharedMemory(NamedTuple):
    """Memory shared with Python.

    stop      stop flag
    progress  ticks, missed deadlines (both including previous loops), and 1 if the loop failed because it was woken
              late
    switch    switch of the force (`force_switch.py`)
    tuning    parameters
    ring      a row per tick, with the records of all fingers one after the other
    wake_fd   eventfd that wakes the reader of records
    motion    motion of the bodies (query.bodies)
    """

    stop: NDArray[np.int64]
    progress: NDArray[np.int64]
    switch: NDArray[np.int64]
    tuning: Slot
    ring: Ring
    wake_fd: int
    motion: Slot


class Scratch(NamedTuple):
    """Private memory of the loop, allocated before it starts.

    buffers  buffers of each device; their records are parts of `row`
    ramp     ramp from the present parameters to the requested ones
    """

    timespec: NDArray[np.int64]
    values: NDArray[np.float64]
    row: NDArray[np.float64]
    buffers: tuple[DeviceBuffers, ...]
    ramp: ParameterRamp
    motion: NDArray[np.float64]


@jit
def update_parameters(
    slot: Slot, version: int, values: NDArray[np.float64], ramp: ParameterRamp, tuning: Tuning
) -> tuple[int, Tuning]:
    """Return the version of the latest parameters, and the ramped parameters of this tick."""
    newest = refresh(slot, version, values)
    if newest != version:
        set_target(ramp, values)
    if ramp.ticks_left[0] > 0:
        advance(ramp)
        tuning = unpack(tuning, ramp.now)
    return newest, tuning


@jit
def with_switch(tuning: Tuning, buffers: Any, hands: Any, switch: NDArray[np.int64], now: int) -> tuple[bool, Tuning]:
    """Return whether the force is on, and the parameters with `apply_switch` of each guard.

    hands  FingerMemory of each finger, with its last wrench
    """
    on = is_on(switch, now)
    fingers = tuning.guards, field_of_each(hands, "guard_state"), field_of_each(buffers, "ignored_ticks")
    guards = map_each(apply_switch, fingers, on)
    return on, Tuning(tuning.scene, guards, tuning.passivity, tuning.tools, tuning.offsets)


@jit
def write_last_zeros(ios: Any, buffers: Any) -> None:
    """Write zero to all devices, the last act of every loop: first to healthy ones, because a failed one may hang."""
    map_each(write_zero_to, (ios, buffers), 0)
    map_each(write_zero_to, (ios, buffers), 1)


@jit
def make_stamp(schedule: Schedule, pace: Pace, woke: int, wrote: int, busy: int) -> Stamp:
    """Return the loop's part of a record: deadline, start and write of the tick, ns; `busy` is of the previous tick."""
    return Stamp(
        timestamp=(woke + schedule.epoch_ns) / NS_PER_S,
        late=(woke - pace.deadline) / NS_PER_S,
        exec=(wrote - woke) / NS_PER_S,
        missed=pace.missed,
        busy=busy / NS_PER_S,
    )


@jit
def publish_record(shared: SharedMemory, row: NDArray[np.float64], ticks: int) -> None:
    """Append a tick's records to the ring and wake the reader; `ticks` includes this tick."""
    push(shared.ring, row)
    store_release(shared.progress, 0, ticks)
    wake_eventfd(shared.wake_fd)


@jit
def schedule_next(
    shared: SharedMemory, schedule: Schedule, pace: Pace, woke: int, timespec: NDArray[np.int64]
) -> tuple[int, Pace]:
    """Return the duration of the tick that started at `woke`, ns, and the pace of the next tick."""
    end = read_clock_ns(timespec)
    pace = compute_next_pace(pace, end, schedule.period_ns)
    store_release(shared.progress, 1, pace.missed)
    return end - woke, pace


@entry
def run_servo_loop(
    like: Tuning, start: Memory, ios: tuple[DeviceIO, ...], schedule: Schedule, shared: SharedMemory, scratch: Scratch
) -> tuple[int, int, int]:
    """Run ticks until stopped; return the reason for the end, the last status of a device, and the index of its finger.

    Ticks and missed deadlines continue from `shared`. In any case, the last write to every device is zero.
    """
    timespec, buffers = scratch.timespec, scratch.buffers
    samples, records = field_of_each(buffers, "sample"), field_of_each(buffers, "record")
    nominal, version = schedule.period_ns / NS_PER_S, refresh(shared.tuning, -1, scratch.values)
    set_now(scratch.ramp, scratch.values)
    tuning, memory, fault_times = unpack(like, scratch.ramp.now), start, NO_FAULT_TIMES
    number, busy, ending, status, finger = load_acquire(shared.progress, 0), 0, STOPPED, 0, 0
    pace = make_first_pace(read_clock_ns(timespec), schedule.period_ns, load_acquire(shared.progress, 1), timespec)

    while load_acquire(shared.stop, 0) == 0:
        if number == schedule.ticks:
            ending = FINISHED
            break
        sleep_until(pace.deadline, timespec)
        woke = read_clock_ns(timespec)
        pace = with_suspension(pace, woke, timespec)
        dt = nominal if schedule.own_clock else pace.dt

        version, tuning = update_parameters(shared.tuning, version, scratch.values, scratch.ramp, tuning)
        reads = ios, buffers, tuning.guards, tuning.offsets, start.fingers, memory.fingers
        fingers_after_read, statuses = unzip(map_each(read_one, reads, dt))
        index, status = find_first_ended(statuses)
        if index >= 0:
            ending, finger = FINISHED if status == END else READ_FAILED, index
            break
        memory = Memory(memory.world, fingers_after_read)
        on, tuning_now = with_switch(tuning, buffers, fingers_after_read, shared.switch, woke)
        memory = run_tick(tuning_now, start, memory, samples, dt, nominal, number, records)
        writes = ios, buffers, tuning.tools, start.fingers, fingers_after_read, memory.fingers
        hands, statuses_out = unzip(map_each(write_one, writes))
        wrote = read_clock_ns(timespec)
        move_bodies(tuning.scene.bodies, number, wrote, shared.motion, scratch.motion, timespec)
        index, status_out = find_first_ended(statuses_out)
        if index >= 0:
            ending, status, finger = WRITE_FAILED, status_out, index
            break
        memory = Memory(memory.world, hands)
        store_active(shared.switch, hands, on)
        count_unreachable(shared.switch, schedule.period_ns)
        stamp = make_stamp(schedule, pace, woke, wrote, busy)
        map_each(stamp_one, (buffers, statuses, statuses_out), stamp)
        number += 1
        publish_record(shared, scratch.row, number)
        busy, pace = schedule_next(shared, schedule, pace, woke, timespec)
        bits, index = collect_guard_bits(buffers)
        last_dt = nominal if schedule.own_clock else pace.dt
        fault_times, fault = detect_fault(fault_times, bits, stamp.late, last_dt, nominal)
        if fault != 0:
            ending, finger = fault, index
            store_release(shared.progress, 2, int(fault_times.late > 0.5 * fault_times.lost))
            break

    write_last_zeros(ios, buffers)
    return ending, status, finger
