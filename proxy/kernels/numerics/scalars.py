"""Helpers for scalars."""

from softfinger.proxy.kernels.jit.decorators import jit


@jit
def clamp(x: float, largest: float) -> float:
    return min(max(x, -largest), largest)
