"""Exchange with a stand-in for a maker's library that returns arbitrary bits."""

from typing import Any

from softfinger.drivers.base import OK, STALE
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.foreign import call_int32


@entry
def exchange_garbage(
    callback: int, read: int, write: int, handle: int, sample: Any, wrench: Any, out: Any, count: int
) -> None:
    """Call the library's `callback` unless it is 0, read and write, `count` times.

    out  (3,)  statuses except OK and STALE; orientations neither NaN nor of unit length; orientations except NaN
    """
    for _ in range(count):
        if callback != 0:
            call_int32(callback, (handle,))
        status = call_device(read, handle, sample)
        if status not in (OK, STALE):
            out[0] += 1
        norm = 0.0
        for k in range(3, 7):
            norm += sample[k] * sample[k]
        if norm == norm:
            out[2] += 1
            if not abs(norm - 1.0) < 1e-9:
                out[1] += 1
        for k in range(6):
            wrench[k] = sample[k]
        call_device(write, handle, wrench)
