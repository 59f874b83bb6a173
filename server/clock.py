"""The monotonic clock and the sleep of the servo loop: two libc calls, made without the GIL."""

from typing import Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit import jit

CLOCK_MONOTONIC: Final = 1
TIMER_ABSTIME: Final = 1
EINTR: Final = 4
NS_PER_S: Final = 1_000_000_000

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
def sleep_until(deadline_ns: int, timespec: NDArray[np.int64]) -> None:
    """Sleep until the monotonic clock shows `deadline_ns`; a signal does not end the sleep early."""
    timespec[0] = deadline_ns // NS_PER_S
    timespec[1] = deadline_ns % NS_PER_S
    while _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, timespec.ctypes, timespec.ctypes) == EINTR:
        pass


def period_ns(rate_hz: float) -> int:
    """Length of a tick in whole ns; the nominal dt is this over 1e9, everywhere."""
    return round(NS_PER_S / rate_hz)
