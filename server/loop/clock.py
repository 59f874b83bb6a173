"""The clock of a loop: two libc calls, made without the GIL, and the grid of deadlines that it keeps.

Monotonic time, and with it a sleep until a deadline, stands still while the machine is suspended: no deadline is missed
by that. CLOCK_BOOTTIME goes on, and tells that a tick began later than its deadline says.
"""

from typing import Final, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.decorators import jit

CLOCK_MONOTONIC: Final = 1
CLOCK_THREAD_CPUTIME_ID: Final = 3
CLOCK_BOOTTIME: Final = 7
TIMER_ABSTIME: Final = 1
EINTR: Final = 4
NS_PER_S: Final = 1_000_000_000
SUSPENSION_MIN_S: Final = 0.1
"""A shorter one is none, but a thread that had to wait between its readings of two clocks; the guard carries a force
over so long a pause."""
SUSPENSION_MAX_S: Final = 1.0
"""What counts of a longer one: enough for all that ends with a pause, and no filter has to bear an hour."""

_timespec = types.CPointer(types.int64)
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, _timespec))
_clock_nanosleep = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, _timespec, _timespec)
)


@jit
def now_ns(timespec: NDArray[np.int64]) -> int:
    """Monotonic time in ns; `timespec` (2,) int64 is scratch."""
    _clock_gettime(CLOCK_MONOTONIC, timespec.ctypes)
    return timespec[0] * NS_PER_S + timespec[1]


@jit
def suspended_ns(now: int, timespec: NDArray[np.int64]) -> int:
    """How long the machine has been suspended since its start, ns, where monotonic time has just been `now` (ns)."""
    _clock_gettime(CLOCK_BOOTTIME, timespec.ctypes)
    return timespec[0] * NS_PER_S + timespec[1] - now


@jit
def thread_cpu_ns(timespec: NDArray[np.int64]) -> int:
    """Time that this thread has had a processor for, in ns: other threads and programs do not count."""
    _clock_gettime(CLOCK_THREAD_CPUTIME_ID, timespec.ctypes)
    return timespec[0] * NS_PER_S + timespec[1]


class Stopwatch(NamedTuple):
    """How long each block of a kernel took, as the kernel itself reads the clock.

    timespec  (2,) int64            scratch
    ns        (blocks,) int64       out: time of each; (blocks, m) where each is timed in m parts
    """

    timespec: NDArray[np.int64]
    ns: NDArray[np.int64]


def stopwatch(*blocks: int) -> Stopwatch:
    """A stopwatch at zero for so many blocks, or blocks and parts."""
    return Stopwatch(np.zeros(2, np.int64), np.zeros(blocks, np.int64))


@jit
def sleep_until(deadline_ns: int, timespec: NDArray[np.int64]) -> None:
    """Sleep until the monotonic clock shows `deadline_ns`; a signal does not end the sleep early."""
    timespec[0] = deadline_ns // NS_PER_S
    timespec[1] = deadline_ns % NS_PER_S
    while _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, timespec.ctypes, timespec.ctypes) == EINTR:
        pass


class Pace(NamedTuple):
    """Where a loop stands on its grid: the next deadline (ns), deadlines skipped before it, missed in all, the time (s)
    from one tick to the next, a period when none was skipped, and how long (ns) the machine has been suspended."""

    deadline: int
    skipped: int
    missed: int
    dt: float
    suspended: int


@jit
def first_pace(now: int, period: int, missed: int, timespec: NDArray[np.int64]) -> Pace:
    """The pace before the first tick, due a period (ns) from `now` (ns), which it is; `missed` by the loops before."""
    return Pace(now + period, 0, missed, period / NS_PER_S, suspended_ns(now, timespec))


@jit
def with_suspension(pace: Pace, woke: int, timespec: NDArray[np.int64]) -> Pace:
    """The pace of a tick that begins at `woke` (ns), which it is: with a suspension in the time since the last one."""
    suspended = suspended_ns(woke, timespec)
    dt, slept = pace.dt, (suspended - pace.suspended) / NS_PER_S
    if slept > SUSPENSION_MIN_S:
        dt += min(slept, SUSPENSION_MAX_S)
    return Pace(pace.deadline, pace.skipped, pace.missed, dt, suspended)


@jit
def next_pace(pace: Pace, now: int, period: int) -> Pace:
    """The pace after a tick that was done at `now` (ns). A `period` of 0 ns is a loop without pauses: none is missed.

    After an overrun it goes on at the next deadline of the same grid: a burst of late ticks helps nobody.
    """
    deadline, skipped = pace.deadline + period, 0
    if period > 0 and now > deadline:
        skipped = (now - deadline) // period + 1
        deadline += skipped * period
    return Pace(deadline, skipped, pace.missed + skipped, period / NS_PER_S * (1 + skipped), pace.suspended)


def period_ns(rate_hz: float) -> int:
    """Length of a tick in whole ns; the nominal dt is this over 1e9, everywhere."""
    return round(NS_PER_S / rate_hz)
