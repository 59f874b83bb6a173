"""Functions of scalars."""

from math import floor

from softfinger.proxy.kernels.jit.decorators import jit

Four = tuple[float, float, float, float]

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


@jit
def compute_spline_weights(t: float) -> tuple[Four, Four, Four]:
    """Return the weights of a uniform cubic B-spline for four neighbours, and their first and second derivatives.

    t  position between the middle two, 0 to 1
    """
    s = 1.0 - t
    tt, ss = t * t, s * s
    value = (ss * s / 6.0, (4.0 - 3.0 * tt * (2.0 - t)) / 6.0, (4.0 - 3.0 * ss * (2.0 - s)) / 6.0, tt * t / 6.0)
    slope = (-0.5 * ss, (1.5 * t - 2.0) * t, (2.0 - 1.5 * s) * s, 0.5 * tt)
    return value, slope, (s, 3.0 * t - 2.0, 1.0 - 3.0 * t, t)


@jit
def weigh(weight: Four, z0: float, z1: float, z2: float, z3: float) -> float:
    """Return the weighted sum of four values."""
    return weight[0] * z0 + weight[1] * z1 + weight[2] * z2 + weight[3] * z3
