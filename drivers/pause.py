"""When the loop has paused: what the drivers that exchange packets themselves do with an answer that is old.

A loop that stood still (compiling, stopped in a debugger, starved by its machine) finds answers of before, or answers
to what it asked before. They are thrown away and one of now is awaited, for a short while where there is a sample to
repeat. The pause itself is no silence of the device, for nobody listened; but its last sample is old, so no force goes
out until there is a new one.
"""

from __future__ import annotations

from typing import Final

from softfinger.proxy.kernels.jit.decorators import jit

RESUME_NS: Final = 30_000_000
"""A pause is longer than three periods of the slowest loop; a hand moves by millimetres in it."""
RESUME_WAIT_NS: Final = 100_000_000
"""How long a running loop waits for an answer of now: the supervisor ends one that stands still for 0.25 s."""


@jit
def heard_at(heard: int, read: int, now: int, quiet: int) -> int:
    """When the device is taken to have been heard last, after a pause of the loop.

    heard  ns  when it was
    read   ns  when the loop last listened
    quiet  ns  of silence, after which it gets no force
    """
    return min(heard + now - read, now - quiet - 1)
