"""Helpers for scalars."""

from math import floor

from softfinger.proxy.kernels.jit.decorators import jit

TURNS_CEILING = 1e15
"""Number of turns above which float64 cannot represent a fraction of a turn."""


@jit
def clamp(x: float, largest: float) -> float:
    return min(max(x, -largest), largest)


@jit
def fraction(turns: float) -> float:
    """Return the fraction of a turn in [0, 1)."""
    turns = clamp(turns, TURNS_CEILING)
    return turns - floor(turns)
