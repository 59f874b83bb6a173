"""Exchange with a device in a nopython loop like the servo's, without a scene; zero force unless a push is requested.

A thread exchanges with the device all the time, because an idle device may switch its force off or lose its position.
In between, parts are recorded: at the rig's rate, or as fast as possible.

The compiled loop, its memory and the thread that runs it are in one file, since each depends on the layout of the
others.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from math import pi, sin
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import SafetyStop
from softfinger.config.schema import Rig
from softfinger.drivers.base import END, HELD, OK, SAMPLE_SIZE, WITHHELD, Device, DeviceIO
from softfinger.drivers.system.libc import IO_SIGNATURE
from softfinger.proxy.kernels.jit.atomics import call_device, load_acquire, store_release
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.proxy.kernels.jit.decorators import c_function, entry, jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.server.loop import realtime, shutdown
from softfinger.server.loop.all_devices import write_wrench
from softfinger.server.loop.clock import (
    NS_PER_S,
    compute_next_pace,
    compute_period_ns,
    make_first_pace,
    read_clock_ns,
    sleep_until,
    with_suspension,
)
from softfinger.server.loop.fault_detection import STALL_POLL_S, Watchdog
from softfinger.server.loop.guard import INITIAL_GUARD_STATE, Guard, GuardState, guard_wrench
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.progress import show_progress
from softfinger.tools.measure import Array

# Columns of a row; times in s.
START: Final = 0  # since the start of the part
LATE: Final = 1  # wake-up after the deadline
READ: Final = 2
WRITE: Final = 3
EMPTY_READ: Final = 4  # the same calls of empty functions, in the same tick
EMPTY_WRITE: Final = 5
READ_STATUS: Final = 6
WRITE_STATUS: Final = 7
FORCE: Final = 8  # three, N, as written
SAMPLE: Final = 11
ROW_SIZE: Final = SAMPLE + SAMPLE_SIZE

BURST_ROWS: Final = 20_000
BURST_NS: Final = 300_000_000
"""End of a part without pauses.

A third of a second is shorter than the 0.95 s after which the kernel throttles a SCHED_FIFO thread that never sleeps,
and than the time that other programs tolerate on a machine with one processor.
"""
FORCE_CYCLES: Final = 3.0
"""Sine cycles in a push, under an envelope that starts and ends at zero."""
JOIN_S: Final = 2.0
"""An exchange that takes longer than this to end hangs; the device is then stopped by the caller's thread."""

# Indices of the words shared with the loop.
_STOP_FLAG: Final = 0  # stops the loop
_NEXT: Final = 1  # ends the wait for the next part
_TICKS: Final = 2


class PartTiming(NamedTuple):
    """Timing of a part.

    period_ns  0: without pauses
    limit_ns   duration after which a part ends; -1: no end
    waiting    1: exchange until the next part
    """

    period_ns: int
    limit_ns: int
    waiting: int


class Push(NamedTuple):
    """Sine of the amplitude `force` (3,) N and `frequency` Hz, under an envelope of `duration` s."""

    force: Vec3
    frequency: float
    duration: float


class Buffers(NamedTuple):
    """Memory of the loop: (2,) int64 for the clock, (SAMPLE_SIZE,) and (6,) float64 for the device."""

    timespec: NDArray[np.int64]
    sample: Array
    wrench: Array


NO_PUSH: Final = Push((0.0, 0.0, 0.0), 1.0, 1.0)


@c_function(IO_SIGNATURE)
def _do_nothing(handle: int, values: Any) -> int:
    return OK


@jit
def push_force(push: Push, t: float) -> Vec3:
    """Return the force (3,) N of a push at `t` (s) after its start."""
    share = t / push.duration
    if not 0.0 <= share <= 1.0:
        return (0.0, 0.0, 0.0)
    size = sin(pi * share) ** 2 * sin(2.0 * pi * push.frequency * t)
    return (size * push.force[0], size * push.force[1], size * push.force[2])


class ExchangeResult(NamedTuple):
    """Result of one exchange.

    guarded                   state of the guard; zero force if the force was withheld
    status, status_out        status of the read and of the write
    read, before, wrote       ns, after the read, before the write, after the write
    empty_read, empty_wrote   ns, the same for the empty device
    """

    guarded: GuardState
    status: int
    status_out: int
    read: int
    before: int
    wrote: int
    empty_read: int
    empty_wrote: int


@jit
def exchange_once(
    io: DeviceIO,
    empty: DeviceIO,
    guard: Guard,
    guarded: GuardState,
    force: Vec3,
    dt: float,
    period: float,
    scratch: Buffers,
) -> ExchangeResult:
    """Read, write a force (3,) N through the guard, and do the same with the empty device; stop at a failure."""
    timespec, sample, wrench = scratch
    status = call_device(io.read, io.handle, sample)
    read = read_clock_ns(timespec)
    if status < 0 or status == END:
        return ExchangeResult(guarded, status, OK, read, read, read, read, read)
    if status == WITHHELD:
        guarded = INITIAL_GUARD_STATE
    previous = guarded
    guarded, _ = guard_wrench(guard, guarded, force, (0.0, 0.0, 0.0), dt, period)
    write_wrench(wrench, guarded.force, guarded.torque)
    before = read_clock_ns(timespec)
    status_out = call_device(io.write, io.handle, wrench)
    wrote = read_clock_ns(timespec)
    if status_out < 0:
        return ExchangeResult(guarded, status, status_out, read, before, wrote, wrote, wrote)
    if status_out == WITHHELD:
        guarded = INITIAL_GUARD_STATE
    elif status_out == HELD:
        guarded = GuardState(previous.force, previous.torque, guarded.gain)
    call_device(empty.read, empty.handle, sample)
    empty_read = read_clock_ns(timespec)
    call_device(empty.write, empty.handle, wrench)
    return ExchangeResult(guarded, status, status_out, read, before, wrote, empty_read, read_clock_ns(timespec))


@jit
def fill_row(row: Array, begun: int, woke: int, late: int, exchanged: ExchangeResult, sample: Array) -> None:
    row[START], row[LATE] = (woke - begun) / NS_PER_S, late / NS_PER_S
    row[READ], row[WRITE] = (exchanged.read - woke) / NS_PER_S, (exchanged.wrote - exchanged.before) / NS_PER_S
    row[EMPTY_READ] = (exchanged.empty_read - exchanged.wrote) / NS_PER_S
    row[EMPTY_WRITE] = (exchanged.empty_wrote - exchanged.empty_read) / NS_PER_S
    row[READ_STATUS], row[WRITE_STATUS] = exchanged.status, exchanged.status_out
    for k in range(3):
        row[FORCE + k] = exchanged.guarded.force[k]
    for k in range(SAMPLE_SIZE):
        row[SAMPLE + k] = sample[k]


@entry
def exchange_loop(
    io: DeviceIO,
    empty: DeviceIO,
    span: PartTiming,
    push: Push,
    guard: Guard,
    words: NDArray[np.int64],
    scratch: Buffers,
    rows: Array,
) -> tuple[int, int, int]:
    """Exchange until the rows are full, or as `span` requires.

    words  (8,)           shared with Python
    rows   (n, ROW_SIZE)  a row a tick

    Returns the reason of the end (server.loop.shutdown), the last status of the device, and the number of rows. In
    every case the last value written to the device is zero.
    """
    timespec, sample, wrench = scratch
    nominal = span.period_ns / NS_PER_S
    guarded, number, ending, status = INITIAL_GUARD_STATE, 0, shutdown.FINISHED, 0
    ticks = load_acquire(words, _TICKS)
    start = read_clock_ns(timespec)
    pace = make_first_pace(start, span.period_ns, 0, timespec)

    while span.waiting == 1 or number < rows.shape[0]:
        if load_acquire(words, _STOP_FLAG) != 0 or (span.waiting == 1 and load_acquire(words, _NEXT) != 0):
            ending = shutdown.STOPPED
            break
        if span.period_ns > 0:
            sleep_until(pace.deadline, timespec)
        woke = read_clock_ns(timespec)
        pace = with_suspension(pace, woke, timespec)
        if 0 <= span.limit_ns < woke - start:
            break
        exchanged = exchange_once(
            io, empty, guard, guarded, push_force(push, number * nominal), pace.dt, nominal, scratch
        )
        guarded, status = exchanged.guarded, exchanged.status
        if status < 0 or status == END:
            ending = shutdown.FINISHED if status == END else shutdown.READ_FAILED
            break
        if exchanged.status_out < 0:
            ending, status = shutdown.WRITE_FAILED, exchanged.status_out
            break
        if span.waiting == 0:
            fill_row(rows[number], start, woke, woke - pace.deadline, exchanged, sample)
        number += 1
        store_release(words, _TICKS, ticks + number)
        pace = compute_next_pace(pace, exchanged.empty_wrote, span.period_ns)

    shutdown.write_zero(io.write, io.handle, wrench)
    return ending, status, 0 if span.waiting == 1 else number


KERNELS: Final = 80
"""Kernels that the exchange compiles with an empty cache: rounded up for the rig `simulated` (72)."""


def make_scratch() -> Buffers:
    return Buffers(np.zeros(2, np.int64), np.zeros(SAMPLE_SIZE), np.zeros(6))


def compile_exchange() -> None:
    """Compile the loop, which its thread would otherwise do after it has armed the device."""
    like = (DeviceIO(0, 0, 0), DeviceIO(0, 0, 0), PartTiming(0, 0, 0), NO_PUSH, Guard(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    arguments = (*like, np.zeros(8, np.int64), make_scratch(), np.zeros((1, ROW_SIZE)))
    require_machine_code("the exchange")
    COMPILE_PROGRESS.expect(KERNELS)
    with show_progress("kernels of the exchange"):
        exchange_loop.compile(tuple(numba.typeof(argument) for argument in arguments))  # type: ignore[attr-defined]


class _RecordedPart:
    """Part to record: input of the loop, and its result."""

    def __init__(self, span: PartTiming, push: Push, count: int) -> None:
        self.span, self.push = span, push
        self.rows = np.empty((count, ROW_SIZE))
        self.rows.fill(0.0)  # avoids first-touch page faults in the loop
        self.finished = threading.Event()


class Exchange:
    """Thread that exchanges with an open device, at zero force except for pushes.

    device   is stopped if the loop hangs, and remains open
    rig      provides rate and real-time settings
    guard    limits every force; a disarmed guard passes none

    The thread arms the device directly before its first exchange. It runs inside the context. Raises the errors of
    real-time settings if the rig requires them, and the errors of arming.
    """

    def __init__(self, device: Device, rig: Rig, guard: Guard) -> None:
        self.device, self.rate_hz = device, rig.servo.rate_hz
        self.settings: list[realtime.Setting] = []
        self.ended: shutdown.LoopEnd | None = None
        """Reason why the exchange stopped by itself; None while it runs."""
        self._servo, self._guard = rig.servo, guard
        self._period = compute_period_ns(rig.servo.rate_hz)
        self._words = np.zeros(8, np.int64)
        self._parts: queue.SimpleQueue[_RecordedPart] = queue.SimpleQueue()
        self._part: _RecordedPart | None = None
        io = device.io()
        self._devices = (DeviceIO(io.read, io.write, io.handle), DeviceIO(_do_nothing.address, _do_nothing.address, 1))
        self._scratch = make_scratch()
        self._armed = False
        self._stop_event = threading.Event()
        self._thread = threading.Thread(target=self._run, name="exchange", daemon=True)

    def record(self, seconds: float, push: Push = NO_PUSH, operation: str = "the exchange with the device") -> Array:
        """Return rows (n, ROW_SIZE) of `seconds` at the rig's rate; fewer if the exchange stops.

        `operation` is recorded, for the progress line. Raises SafetyStop if the exchange hangs.
        """
        part = _RecordedPart(PartTiming(self._period, -1, 0), push, max(1, round(seconds * self.rate_hz)))
        with show_progress(f"recording {operation}", len(part.rows)) as update:
            return self._record(part, update)

    def burst(self) -> Array:
        """Return rows of exchanges without pauses, at most BURST_ROWS and BURST_NS."""
        return self._record(_RecordedPart(PartTiming(0, BURST_NS, 0), NO_PUSH, BURST_ROWS), lambda number: None)

    def failure(self) -> Exception | None:
        """Return the error of a device that failed; None while it runs, and at the end of a recording."""
        return None if self.ended is None else shutdown.describe_failure(self.device, self.ended)

    def _record(self, part: _RecordedPart, advance: Callable[[int], None]) -> Array:
        first = int(self._words[_TICKS])
        self._parts.put(part)
        self._words[_NEXT] = 1
        watchdog = Watchdog()
        while not part.finished.wait(STALL_POLL_S):
            if self._stop_event.is_set():
                break
            ticks = int(self._words[_TICKS])
            advance(ticks - first)
            if idle_s := watchdog.measure_stall_s(ticks, self._armed):
                stalled = SafetyStop(
                    f"{self.device.info.name}: no exchange for {idle_s:.2f} s after exchange {ticks}: "
                    "zero force was commanded; the device hangs, or this machine starves the thread"
                )
                shutdown.run_all_steps(lambda: shutdown.stop(self.device), first=stalled)
                raise stalled
        self._raise_crash()
        return part.rows if part.finished.is_set() else part.rows[:0]

    def _run(self) -> None:
        applied: realtime.AppliedSettings | None = None
        try:
            applied = realtime.apply(self._servo.realtime, self._servo.priority, self._servo.cpu)
            self.settings = applied.settings
            waiting = _RecordedPart(PartTiming(self._period, -1, 1), NO_PUSH, 0)
            self.device.arm()
            self._armed = True
            while self.ended is None and not self._words[_STOP_FLAG]:
                self._words[_NEXT] = 0  # before the queue is read: a later part then ends the waiting at once
                try:
                    part = self._parts.get_nowait()
                except queue.Empty:
                    part = waiting
                ending, status, count = exchange_loop(
                    *self._devices, part.span, part.push, self._guard, self._words, self._scratch, part.rows
                )
                if ending in (shutdown.READ_FAILED, shutdown.WRITE_FAILED) or status == END:
                    self.ended = shutdown.LoopEnd(ending, status)
                part.rows = part.rows[:count]
                if part is not waiting:
                    part.finished.set()
        except BaseException as error:  # for any error, the device must be zeroed and the caller informed
            self.ended = shutdown.LoopEnd(shutdown.CRASHED, 0, error)
        first = None if self.ended is None else self.ended.error
        undo = [] if applied is None else [applied.undo]
        failed = shutdown.run_all_steps(
            lambda: shutdown.stop(self.device), lambda: shutdown.confirm_zero([self.device]), *undo, first=first
        )
        if self.ended is None and failed is not None:
            self.ended = shutdown.LoopEnd(shutdown.CRASHED, 0, failed)
        self._stop_event.set()

    def _raise_crash(self) -> None:
        if self.ended is not None and self.ended.error is not None:
            raise self.ended.error

    def __enter__(self) -> Self:
        compile_exchange()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._words[_STOP_FLAG] = 1
        if not self._stop_event.wait(JOIN_S):
            shutdown.run_all_steps(lambda: shutdown.stop(self.device), first=error)
        elif error is None:
            self._raise_crash()


def make_disarmed_guard(rig: Rig) -> Guard:
    guard = rig.guard
    return Guard(0.0, 0.0, guard.force_slew_n_per_s, guard.torque_slew_nm_per_s, guard.ramp_s, 0.0)
