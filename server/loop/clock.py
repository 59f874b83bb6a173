"""Clock of a loop: libc calls without the GIL, and the grid of deadlines.

Monotonic time, and with it a sleep until a deadline, stops while the machine is suspended, so a suspension misses no
deadline. CLOCK_BOOTTIME continues during a suspension, so it shows how late a tick started in real time.
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
"""Shorter differences are not a suspension: the thread may have waited between its readings of the two clocks. The
guard also continues a force over a pause of this length."""
SUSPENSION_MAX_S: Final = 1.0
"""Part of a longer suspension that counts: it exceeds every pause limit, and no filter is fed an hour as time step."""

_timespec = types.CPointer(types.int64)
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, _timespec))
_clock_nanosleep = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, _timespec, _timespec)
)


@jit
def read_clock_ns(timespec: NDArray[np.int64]) -> int:
    """Return monotonic time in ns; `timespec` (2,) int64 is scratch."""
    _clock_gettime(CLOCK_MONOTONIC, timespec.ctypes)
    return timespec[0] * NS_PER_S + timespec[1]


@jit
def read_suspended_ns(now: int, timespec: NDArray[np.int64]) -> int:
    """Return for how long the machine has been suspended since boot, ns; `now` (ns) is the monotonic time just read."""
    _clock_gettime(CLOCK_BOOTTIME, timespec.ctypes)
    return timespec[0] * NS_PER_S + timespec[1] - now


@jit
def read_thread_cpu_ns(timespec: NDArray[np.int64]) -> int:
    """Return processor time of this thread in ns, without the time of other threads and programs."""
    _clock_gettime(CLOCK_THREAD_CPUTIME_ID, timespec.ctypes)
    return timespec[0] * NS_PER_S + timespec[1]


class Stopwatch(NamedTuple):
    """Duration of each block of a kernel, measured by the kernel itself.

    timespec  (2,) int64            scratch
    ns        (blocks,) int64       out: duration of each block; (blocks, m) if each block is timed in m parts
    """

    timespec: NDArray[np.int64]
    ns: NDArray[np.int64]


def make_stopwatch(*blocks: int) -> Stopwatch:
    """Return a stopwatch at zero for a number of blocks, or of blocks and parts."""
    return Stopwatch(np.zeros(2, np.int64), np.zeros(blocks, np.int64))


@jit
def sleep_until(deadline_ns: int, timespec: NDArray[np.int64]) -> None:
    """Sleep until the monotonic clock shows `deadline_ns`; a signal does not end the sleep early."""
    timespec[0] = deadline_ns // NS_PER_S
    timespec[1] = deadline_ns % NS_PER_S
    while _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, timespec.ctypes, timespec.ctypes) == EINTR:
        pass


class Pace(NamedTuple):
    """Position of a loop on its grid of deadlines.

    deadline   ns  next deadline
    skipped        deadlines skipped before it
    missed         deadlines missed in total
    dt         s   time from one tick to the next; a period if no deadline was skipped
    suspended  ns  time for which the machine has been suspended since boot
    """

    deadline: int
    skipped: int
    missed: int
    dt: float
    suspended: int


@jit
def make_first_pace(now: int, period: int, missed: int, timespec: NDArray[np.int64]) -> Pace:
    """Return the pace before the first tick, which is due a period (ns) after the present time `now` (ns).

    missed  deadlines missed by the previous loops
    """
    return Pace(now + period, 0, missed, period / NS_PER_S, read_suspended_ns(now, timespec))


@jit
def with_suspension(pace: Pace, woke: int, timespec: NDArray[np.int64]) -> Pace:
    """Return the pace of a tick that starts now, at `woke` (ns); `dt` includes any suspension since the last tick."""
    suspended = read_suspended_ns(woke, timespec)
    dt, slept = pace.dt, (suspended - pace.suspended) / NS_PER_S
    if slept > SUSPENSION_MIN_S:
        dt += min(slept, SUSPENSION_MAX_S)
    return Pace(pace.deadline, pace.skipped, pace.missed, dt, suspended)


@jit
def compute_next_pace(pace: Pace, now: int, period: int) -> Pace:
    """Return the pace after a tick that finished at `now` (ns); with a `period` of 0 ns no deadline is missed.

    After an overrun the loop resumes at the next deadline of the same grid, without a burst of late ticks.
    """
    deadline, skipped = pace.deadline + period, 0
    if period > 0 and now > deadline:
        skipped = (now - deadline) // period + 1
        deadline += skipped * period
    return Pace(deadline, skipped, pace.missed + skipped, period / NS_PER_S * (1 + skipped), pace.suspended)


def compute_period_ns(rate_hz: float) -> int:
    """Return the length of a tick, rounded to ns; the nominal dt is this over 1e9 everywhere."""
    return round(NS_PER_S / rate_hz)
