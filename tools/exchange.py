"""A device's exchange alone, in a nopython loop like the servo's: no scene, and zero force unless a push is asked for.

A thread exchanges with the device from the first moment to the last, because a device that is left alone may turn its
force off or lose its place. In between, parts are recorded: at the rig's rate, or as fast as it goes.
"""

from __future__ import annotations

import queue
import threading
from math import pi, sin
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError, SafetyStop
from softfinger.config.limits import Range
from softfinger.config.schema import Rig
from softfinger.drivers.base import END, OK, SAMPLE_SIZE, Device
from softfinger.drivers.libc import IO_SIGNATURE
from softfinger.proxy.kernels.atomics import call_device, load_acquire, store_release
from softfinger.proxy.kernels.jit import c_function, entry, jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.server import realtime, servo
from softfinger.server.app import STALL_POLL_S, STALL_POLLS, device_failure
from softfinger.server.clock import NS_PER_S, now_ns, period_ns, sleep_until
from softfinger.server.guard import DISENGAGED, Guard, guard_wrench
from softfinger.server.progress import progress
from softfinger.server.servo import put_wrench

Array = NDArray[np.float64]

# Columns of a row; times in s.
START: Final = 0  # since the part began
LATE: Final = 1  # wake-up after the deadline
READ: Final = 2
WRITE: Final = 3
EMPTY_READ: Final = 4  # the same calls of functions that do nothing, in the same tick
EMPTY_WRITE: Final = 5
READ_STATUS: Final = 6
WRITE_STATUS: Final = 7
FORCE: Final = 8  # three, N, as written
SAMPLE: Final = 11
ROW_SIZE: Final = SAMPLE + SAMPLE_SIZE

BURST_ROWS: Final = 20_000
BURST_NS: Final = 300_000_000
"""Ends of a part without pauses. A third of a second is short of the 0.95 s after which the kernel holds back a thread
of SCHED_FIFO that never sleeps, and of what anything else on a machine with one processor bears."""
FORCE_CYCLES: Final = 3.0
"""Sine cycles in a push, under an envelope that begins and ends at zero."""
SECONDS: Final = Range(0.1, 60.0, "a row of every tick is kept in memory")
JOIN_S: Final = 2.0
"""An exchange that takes longer than this to end hangs; the device is stopped over it."""

# Words shared with the loop.
_ENOUGH: Final = 0  # ends everything
_NEXT: Final = 1  # ends waiting, for the next part
_TICKS: Final = 2


class Io(NamedTuple):
    """Device functions and their handle (drivers.base)."""

    read: int
    write: int
    handle: int


class Pace(NamedTuple):
    """period_ns 0: without pauses; limit_ns: a part ends after so long, -1 for no end; waiting 1: until the next."""

    period_ns: int
    limit_ns: int
    waiting: int


class Push(NamedTuple):
    """A sine of `force` (3,) N at its largest, of `frequency` Hz, under an envelope of `duration` s."""

    force: Vec3
    frequency: float
    duration: float


NO_PUSH: Final = Push((0.0, 0.0, 0.0), 1.0, 1.0)


@c_function(IO_SIGNATURE)
def _nothing(handle: int, values: Any) -> int:
    return OK


@jit
def pushed(push: Push, t: float) -> Vec3:
    """Force (3,) N of a push at `t` (s) after its beginning."""
    share = t / push.duration
    if not 0.0 <= share <= 1.0:
        return (0.0, 0.0, 0.0)
    size = sin(pi * share) ** 2 * sin(2.0 * pi * push.frequency * t)
    return (size * push.force[0], size * push.force[1], size * push.force[2])


@entry
def exchange_loop(
    io: Io,
    empty: Io,
    pace: Pace,
    push: Push,
    guard: Guard,
    words: Any,
    timespec: Any,
    sample: Any,
    wrench: Any,
    rows: Any,
) -> tuple[int, int, int]:
    """Exchange until the rows are full, or as `pace` says; returns how it ended (server.servo), the device's last
    status, and how many rows there are.

    words     (3,) int64               shared with Python
    timespec  (2,) int64               scratch; so are sample (SAMPLE_SIZE,) and wrench (6,), float64
    rows      (n, ROW_SIZE) float64    a row a tick

    Whatever the end, the last thing written to the device is zero.
    """
    zero = (0.0, 0.0, 0.0)
    nominal = pace.period_ns / NS_PER_S
    guarded, number, ending, status = DISENGAGED, 0, servo.FINISHED, 0
    ticks = load_acquire(words, _TICKS)
    begun = now_ns(timespec)
    deadline = begun + pace.period_ns

    while pace.waiting == 1 or number < rows.shape[0]:
        if load_acquire(words, _ENOUGH) != 0 or (pace.waiting == 1 and load_acquire(words, _NEXT) != 0):
            ending = servo.STOPPED
            break
        if pace.period_ns > 0:
            sleep_until(deadline, timespec)
        woke = now_ns(timespec)
        if 0 <= pace.limit_ns < woke - begun:
            break
        late = woke - deadline

        status = call_device(io.read, io.handle, sample)
        read = now_ns(timespec)
        if status < 0 or status == END:
            ending = servo.FINISHED if status == END else servo.READ_FAILED
            break
        guarded, _ = guard_wrench(guard, guarded, pushed(push, number * nominal), zero, nominal)
        put_wrench(wrench, guarded.force, guarded.torque)
        before = now_ns(timespec)
        status_out = call_device(io.write, io.handle, wrench)
        wrote = now_ns(timespec)
        if status_out < 0:
            ending, status = servo.WRITE_FAILED, status_out
            break
        call_device(empty.read, empty.handle, sample)
        empty_read = now_ns(timespec)
        call_device(empty.write, empty.handle, wrench)
        empty_wrote = now_ns(timespec)

        if pace.waiting == 0:
            row = rows[number]
            row[START] = (woke - begun) / NS_PER_S
            row[LATE] = late / NS_PER_S
            row[READ] = (read - woke) / NS_PER_S
            row[WRITE] = (wrote - before) / NS_PER_S
            row[EMPTY_READ] = (empty_read - wrote) / NS_PER_S
            row[EMPTY_WRITE] = (empty_wrote - empty_read) / NS_PER_S
            row[READ_STATUS] = status
            row[WRITE_STATUS] = status_out
            for k in range(3):
                row[FORCE + k] = guarded.force[k]
            for k in range(SAMPLE_SIZE):
                row[SAMPLE + k] = sample[k]
        number += 1
        store_release(words, _TICKS, ticks + number)

        # After an overrun go on at the next deadline of the same grid, as the servo does.
        deadline += pace.period_ns
        if pace.period_ns > 0 and empty_wrote > deadline:
            deadline += ((empty_wrote - deadline) // pace.period_ns + 1) * pace.period_ns

    for i in range(6):
        wrench[i] = 0.0
    call_device(io.write, io.handle, wrench)
    return ending, status, 0 if pace.waiting == 1 else number


def scratch() -> tuple[Any, ...]:
    """Memory of the loop alone: timespec, sample, wrench."""
    return np.zeros(2, np.int64), np.zeros(SAMPLE_SIZE), np.zeros(6)


def compile_exchange() -> None:
    """Compile the loop, so that a device that is opened afterwards does not wait for it."""
    like = (Io(0, 0, 0), Io(0, 0, 0), Pace(0, 0, 0), NO_PUSH, Guard(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    arguments = (*like, np.zeros(8, np.int64), *scratch(), np.zeros((1, ROW_SIZE)))
    with progress("compiling the exchange (once for each version)"):
        exchange_loop.compile(tuple(numba.typeof(argument) for argument in arguments))  # type: ignore[attr-defined]


class _Part:
    """A part to record: what the loop is given, and what became of it."""

    def __init__(self, pace: Pace, push: Push, count: int) -> None:
        self.pace, self.push = pace, push
        self.rows = np.empty((count, ROW_SIZE))
        self.rows.fill(0.0)  # so that the loop meets no first-touch page fault
        self.done = threading.Event()


class Exchange:
    """The thread that exchanges with an open device, zero force from beginning to end but for pushes.

    device   is stopped when the loop hangs, and left open
    rig      whose rate and real-time settings it has
    guard    every force passes it; disarmed, none leaves it

    As a context: it runs inside. Raises what real-time settings raise where the rig requires them.
    """

    def __init__(self, device: Device, rig: Rig, guard: Guard) -> None:
        self.device, self.rate_hz = device, rig.servo.rate_hz
        self.settings: list[realtime.Setting] = []
        self.ended: servo.Ended | None = None
        """How the device's exchange has ended by itself; None while it goes on."""
        self._servo, self._guard = rig.servo, guard
        self._period = period_ns(rig.servo.rate_hz)
        self._words = np.zeros(8, np.int64)
        self._parts: queue.SimpleQueue[_Part] = queue.SimpleQueue()
        self._part: _Part | None = None
        io = device.io()
        self._devices = (Io(io.read, io.write, io.handle), Io(_nothing.address, _nothing.address, 1))
        self._scratch = (self._words, *scratch())
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="exchange", daemon=True)

    def record(self, seconds: float, push: Push = NO_PUSH) -> Array:
        """Rows (n, ROW_SIZE) of so many seconds at the rig's rate; fewer where the device has ended meanwhile.

        Raises SafetyStop when the exchange hangs.
        """
        return self._record(_Part(Pace(self._period, -1, 0), push, max(1, round(seconds * self.rate_hz))))

    def burst(self) -> Array:
        """Rows of exchanges without pauses, at most BURST_ROWS and BURST_NS."""
        return self._record(_Part(Pace(0, BURST_NS, 0), NO_PUSH, BURST_ROWS))

    def failure(self) -> Exception | None:
        """The error of a device that failed; None while it goes on, and at the end of a recording."""
        if self.ended is None:
            return None
        failed = self.ended.ending in (servo.READ_FAILED, servo.WRITE_FAILED)
        return device_failure(self.device, self.ended) if failed else None

    def _record(self, part: _Part) -> Array:
        self._parts.put(part)
        self._words[_NEXT] = 1
        seen, idle = -1, 0
        while not part.done.wait(STALL_POLL_S):
            if self._over.is_set():
                break
            ticks = int(self._words[_TICKS])
            idle = idle + 1 if ticks == seen else 0
            seen = ticks
            if idle >= STALL_POLLS and ticks > 0:
                self.device.stop()
                raise SafetyStop(
                    f"{self.device.info.name}: no exchange for {idle * STALL_POLL_S:.2f} s after exchange {ticks}: "
                    "zero force was commanded; the device hangs, or this machine starves the thread"
                )
        self._raise_crash()
        return part.rows if part.done.is_set() else part.rows[:0]

    def _run(self) -> None:
        applied: realtime.Applied | None = None
        try:
            applied = realtime.apply(self._servo.realtime, self._servo.priority, self._servo.cpu)
            self.settings = applied.settings
            waiting = _Part(Pace(self._period, -1, 1), NO_PUSH, 0)
            while self.ended is None and not self._words[_ENOUGH]:
                self._words[_NEXT] = 0  # before the look: what comes after it ends the waiting at once
                try:
                    part = self._parts.get_nowait()
                except queue.Empty:
                    part = waiting
                ending, status, count = exchange_loop(*self._arguments(part))
                if ending in (servo.READ_FAILED, servo.WRITE_FAILED) or status == END:
                    self.ended = servo.Ended(ending, status)
                part.rows = part.rows[:count]
                if part is not waiting:
                    part.done.set()
        except BaseException as error:  # whatever it was, the device must be zeroed and the caller must learn of it
            self.ended = servo.Ended(servo.CRASHED, 0, error)
        finally:
            self.device.stop()
            if applied is not None:
                applied.undo()
            self._over.set()

    def _arguments(self, part: _Part) -> tuple[Any, ...]:
        return (*self._devices, part.pace, part.push, self._guard, *self._scratch, part.rows)

    def _raise_crash(self) -> None:
        if self.ended is not None and self.ended.error is not None:
            raise self.ended.error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._words[_ENOUGH] = 1
        if not self._over.wait(JOIN_S):
            self.device.stop()


def check_seconds(seconds: float) -> None:
    """ConfigError for a part that cannot be recorded."""
    if not SECONDS.low <= seconds <= SECONDS.high:
        raise ConfigError(f"--seconds {seconds:g}: must be from {SECONDS.low:g} to {SECONDS.high:g}: {SECONDS.reason}")


def disarmed(rig: Rig) -> Guard:
    """A guard that lets no force through."""
    given = rig.guard
    return Guard(0.0, 0.0, given.force_slew_n_per_s, given.torque_slew_nm_per_s, given.ramp_s, 0.0)
