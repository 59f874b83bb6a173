"""The servo: one nopython function in a thread of its own, from device read to device write.

The loop takes no GIL, allocates nothing and waits for nobody. It shares with Python: a stop word, a
slot of parameters, a ring of records and an eventfd that tells the reader a record is there.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.drivers.base import END, SAMPLE_BUTTONS, SAMPLE_GRIPPER, SAMPLE_SIZE, Device
from softfinger.proxy.kernels.atomics import call_device, load_acquire, store_release
from softfinger.proxy.kernels.jit import entry, jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.pack import flatten, unpack
from softfinger.proxy.state import OFFSET, RECORD_SIZE
from softfinger.server.clock import NS_PER_S, now_ns, period_ns, sleep_until
from softfinger.server.ring import Ring, make_ring, push, take
from softfinger.server.seqlock import Slot, make_slot, publish, refresh
from softfinger.server.tick import Memory, Tuning, begin, tick

RING_SECONDS: Final = 8
"""How long the reader of records may be held up before any is lost."""

STOPPED: Final = 0
FINISHED: Final = 1
READ_FAILED: Final = 2
WRITE_FAILED: Final = 3
CRASHED: Final = 4

TIMESTAMP: Final = OFFSET["timestamp"]
LATE: Final = OFFSET["servo.late"]
EXEC: Final = OFFSET["servo.exec"]
MISSED: Final = OFFSET["servo.missed"]
BUSY: Final = OFFSET["servo.busy"]
STATUS: Final = OFFSET["servo.device"]
BUTTONS: Final = OFFSET["buttons"]
GRIPPER: Final = OFFSET["gripper"]

_eventfd_write = types.ExternalFunction("eventfd_write", types.int32(types.int32, types.uint64))


class Io(NamedTuple):
    """Device functions and handle (drivers.base), and the eventfd that wakes the reader of records."""

    read: int
    write: int
    handle: int
    wake_fd: int


class Pace(NamedTuple):
    """Period and epoch offset, ns; ticks to run, -1 for no end; whether the device keeps its own clock."""

    period_ns: int
    epoch_ns: int
    ticks: int
    own_clock: int


class Shared(NamedTuple):
    """Memory the loop shares with Python: stop word, ticks and misses so far, parameter slot, ring of records."""

    stop: NDArray[np.int64]
    progress: NDArray[np.int64]
    tuning: Slot
    ring: Ring


class Scratch(NamedTuple):
    """Memory of the loop alone, allocated before it starts."""

    timespec: NDArray[np.int64]
    sample: NDArray[np.float64]
    wrench: NDArray[np.float64]
    record: NDArray[np.float64]
    values: NDArray[np.float64]


@jit
def put_wrench(wrench: NDArray[np.float64], force: Vec3, torque: Vec3) -> None:
    for i in range(3):
        wrench[i] = force[i]
        wrench[3 + i] = torque[i]


@entry
def servo_loop(
    tuning_like: Tuning, start: Memory, io: Io, pace: Pace, shared: Shared, scratch: Scratch
) -> tuple[int, int]:
    """Run ticks until told to stop; returns how it ended and the device's last status.

    Whatever the end, the last thing written to the device is zero.
    """
    timespec, sample, wrench, record = scratch.timespec, scratch.sample, scratch.wrench, scratch.record
    seen = refresh(shared.tuning, -1, scratch.values)
    tuning = unpack(tuning_like, scratch.values)
    memory = start
    nominal = pace.period_ns / NS_PER_S
    number, missed, skipped, busy, ending, status = 0, 0, 0, 0, STOPPED, 0
    deadline = now_ns(timespec) + pace.period_ns

    while load_acquire(shared.stop, 0) == 0:
        if number == pace.ticks:
            ending = FINISHED
            break
        sleep_until(deadline, timespec)
        woke = now_ns(timespec)

        newest = refresh(shared.tuning, seen, scratch.values)
        if newest != seen:
            seen, tuning = newest, unpack(tuning_like, scratch.values)

        status = call_device(io.read, io.handle, sample)
        if status < 0 or status == END:
            ending = FINISHED if status == END else READ_FAILED
            break
        dt = nominal if pace.own_clock else nominal * (1 + skipped)
        memory = tick(tuning, start, memory, sample, dt, number, record)
        put_wrench(wrench, memory.guarded.force, memory.guarded.torque)
        status_out = call_device(io.write, io.handle, wrench)
        wrote = now_ns(timespec)
        if status_out < 0:
            ending, status = WRITE_FAILED, status_out
            break

        record[TIMESTAMP] = (woke + pace.epoch_ns) / NS_PER_S
        record[LATE] = (woke - deadline) / NS_PER_S
        record[EXEC] = (wrote - woke) / NS_PER_S
        record[MISSED] = missed
        record[BUSY] = busy / NS_PER_S
        record[STATUS] = max(status, status_out)
        record[BUTTONS] = sample[SAMPLE_BUTTONS]
        record[GRIPPER] = sample[SAMPLE_GRIPPER]
        push(shared.ring, record)
        number += 1
        store_release(shared.progress, 0, number)
        _eventfd_write(io.wake_fd, 1)

        # After an overrun go on at the next deadline of the same grid: a burst of late ticks helps nobody.
        slept = now_ns(timespec)
        busy = slept - woke
        deadline += pace.period_ns
        skipped = 0
        if slept > deadline:
            skipped = (slept - deadline) // pace.period_ns + 1
            deadline += skipped * pace.period_ns
            missed += skipped
            store_release(shared.progress, 1, missed)

    for i in range(6):
        wrench[i] = 0.0
    call_device(io.write, io.handle, wrench)
    return ending, status


class Ended(NamedTuple):
    """How the loop ended: STOPPED ... CRASHED, the device's last status, and the error if it crashed."""

    ending: int
    status: int
    error: BaseException | None = None


class Servo:
    """A servo loop around one device, ready to start.

    device   an open device; the servo commands zero through it on every way out, but does not close it
    tuning   scene and guard
    rate_hz  tick rate
    ticks    how many ticks to run, None until stopped
    prepare  called in the servo thread before the first tick (real-time settings); what it returns is
             called in the same thread after the last

    Use: `compile`, `start`, `take` again and again after `wait_record`, `stop`, `join`.
    """

    def __init__(
        self,
        device: Device,
        tuning: Tuning,
        rate_hz: float,
        ticks: int | None = None,
        prepare: Callable[[], Callable[[], None]] | None = None,
    ) -> None:
        self.device = device
        self.period_ns = period_ns(rate_hz)
        self._tuning = tuning
        self._prepare = prepare
        self._ended: Ended | None = None
        self._done = threading.Event()
        self._wake_fd = os.eventfd(0)
        capacity = 1 << int(np.ceil(np.log2(max(RING_SECONDS * rate_hz, 1024))))
        values = flatten(tuning)
        self.shared = Shared(
            np.zeros(8, np.int64), np.zeros(8, np.int64), make_slot(values), make_ring(capacity, RECORD_SIZE)
        )
        io = device.io()
        # CLOCK_MONOTONIC is slewed with the wall clock but never stepped, so one offset serves the whole run.
        self._arguments: tuple[Any, ...] = (
            tuning,
            begin(tuning.scene),
            Io(io.read, io.write, io.handle, self._wake_fd),
            Pace(self.period_ns, _epoch_offset_ns(), -1 if ticks is None else ticks, int(device.info.own_clock)),
            self.shared,
            Scratch(
                np.zeros(2, np.int64), np.zeros(SAMPLE_SIZE), np.zeros(6), np.zeros(RECORD_SIZE), values.copy()
            ),
        )  # fmt: skip
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)

    def compile(self) -> bool:
        """Compile everything the loop and its readers call; True if it all came from the cache."""
        kernels: list[tuple[Any, tuple[Any, ...]]] = [
            (servo_loop, self._arguments),
            (take, (self.shared.ring, np.empty((1, RECORD_SIZE)))),
            (publish, (self.shared.tuning, self.shared.tuning.values)),
        ]
        for kernel, arguments in kernels:
            kernel.compile(tuple(numba.typeof(argument) for argument in arguments))
        return all(not kernel.stats.cache_misses for kernel, _ in kernels)

    def start(self) -> None:
        """Start the thread; returns at once."""
        self._thread.start()

    def _run(self) -> None:
        undo: Callable[[], None] | None = None
        try:
            if self._prepare is not None:
                undo = self._prepare()
            ending, status = servo_loop(*self._arguments)
            self._ended = Ended(ending, status)
        except BaseException as error:  # whatever it was, the device must be zeroed and join() must learn of it
            self._ended = Ended(CRASHED, 0, error)
        finally:
            self.device.stop()
            if undo is not None:
                undo()
            self._done.set()
            os.eventfd_write(self._wake_fd, 1)

    def stop(self) -> None:
        """Ask the loop to end after its current tick; from any thread, also from a signal handler."""
        self.shared.stop[0] = 1

    def join(self, timeout_s: float | None = None) -> Ended | None:
        """Wait for the end; None if it has not come within the time."""
        # Not Thread.join: in Python 3.11 an interrupt inside it marks a live thread as finished.
        if not self._done.wait(timeout_s):
            return None
        return self._ended

    @property
    def running(self) -> bool:
        return not self._done.is_set()

    @property
    def looping(self) -> bool:
        """Whether ticks are still to come; after the last one the device is stopped, and then `running` ends."""
        return self._ended is None

    @property
    def ticks(self) -> int:
        """Ticks done so far."""
        return int(self.shared.progress[0])

    @property
    def missed(self) -> int:
        """Deadlines missed so far."""
        return int(self.shared.progress[1])

    @property
    def drops(self) -> int:
        """Records the ring had no room for."""
        return int(self.shared.ring.drops[0])

    def wait_record(self) -> None:
        """Sleep until there is a record to take, or the loop has ended. One thread only."""
        os.eventfd_read(self._wake_fd)

    def take(self, out: NDArray[np.float64]) -> int:
        """Move the oldest records into `out` (n, RECORD_SIZE); returns how many. One thread only."""
        return int(take(self.shared.ring, out))

    def tune(self, tuning: Tuning) -> None:
        """Change parameters while running; the scene's parts must be the same. One thread only."""
        if numba.typeof(tuning) != numba.typeof(self._tuning):
            raise ValueError("the new tuning has other parts than the one compiled: start another servo")
        publish(self.shared.tuning, flatten(tuning))
        self._tuning = tuning

    def close(self) -> None:
        """Release the eventfd, after the loop has ended and its reader has gone."""
        if self._thread.ident is not None:
            self._thread.join()
        if self._wake_fd >= 0:
            os.close(self._wake_fd)
            self._wake_fd = -1


def _epoch_offset_ns() -> int:
    return time.time_ns() - time.monotonic_ns()
