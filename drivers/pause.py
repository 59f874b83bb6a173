"""Handling of old answers after a pause of the loop, for the drivers that exchange packets themselves.

After a pause (compiling, stopped in a debugger, starved by other processes), the loop finds old answers, or answers to
old requests. The drivers discard them and wait for a current one; briefly if there is a sample to repeat. The pause
does not count as silence of the device, because nothing was read in it. Its last sample is old, however, so the drivers
send no force until there is a new one.
"""

from __future__ import annotations

from typing import Final

from softfinger.proxy.kernels.jit.decorators import jit

RESUME_NS: Final = 30_000_000
"""Minimum pause: three periods of the slowest loop; a hand moves by millimetres in it."""
RESUME_WAIT_NS: Final = 100_000_000
"""Longest wait of a running loop for a current answer: the supervisor ends a loop that stalls for 0.25 s."""


@jit
def shift_sample_time(sampled_at: int, read_at: int, now: int, quiet: int) -> int:
    """Return the time (ns) to use as that of the last answer after a pause of the loop.

    sampled_at  ns  time of the last answer
    read_at     ns  time of the last read
    quiet       ns  silence after which no force is sent
    """
    return min(sampled_at + now - read_at, now - quiet - 1)
