"""Tests of the guard with wrenches that no contact should produce, and checks of its output in each tick.

The cases of `extremes` reach the guard through the contact, which computes finite forces for any input. Here the input
goes to the guard directly. The checks are limits of the force at the hand and share no code with the guard.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import inf, nan
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.server.loop.guard import GUARD_NAMES, INITIAL_GUARD_STATE, NOT_FINITE, Guard, guard_wrench
from softfinger.tools.measure import Array

T: Final = 0.001
LIMITS: Final = Guard(12.0, 0.3, 2000.0, 50.0, 0.1, 1.0)
ROUNDING: Final = 1e-9
"""A hundred sums of a ramp, differences of forces; relative to the limit."""
RAMP_TICKS: Final = round(LIMITS.ramp / T)
TICKS: Final = 3 * RAMP_TICKS
BROKEN_TICK: Final = 2 * RAMP_TICKS - 1
STEADY_WRENCH: Final = np.tile([0.6, 0.0, 0.8, 0.0, 0.01, 0.0], (TICKS, 1))
"""1 N and 0.01 N m, below every limit."""


class WrenchCase(NamedTuple):
    """Wrenches (n, 6), times (n,) s since the last tick, and a further check that returns a fault or ""."""

    given: str
    wrenches: Array
    dts: Array
    expects: Callable[[Array, NDArray[np.int64]], str]


@entry
def guard_many(guard: Guard, wrenches: Array, dts: Array, period: float, out: Array, bits: Any) -> None:
    """Run the guard on each row of `wrenches` (n, 6), from disengaged; stores the output (n, 6) and its bits (n,)."""
    guarded = INITIAL_GUARD_STATE
    for i in range(wrenches.shape[0]):
        w = wrenches[i]
        guarded, bits[i] = guard_wrench(guard, guarded, (w[0], w[1], w[2]), (w[3], w[4], w[5]), dts[i], period)
        for k in range(3):
            out[i, k] = guarded.force[k]
            out[i, 3 + k] = guarded.torque[k]


def iter_cases() -> Iterator[WrenchCase]:
    even = np.full(TICKS, T)
    yield WrenchCase("1 N from the first tick on", STEADY_WRENCH, even, lambda out, bits: check_fade_in(out, 0))
    step = STEADY_WRENCH.copy()
    step[:RAMP_TICKS] = 0.0
    step[RAMP_TICKS:] *= 10.0
    yield WrenchCase("10 N from one tick to the next", step, even, check_climb)
    for value, component in ((nan, 0), (inf, 1), (-inf, 2), (nan, 3), (inf, 4), (-inf, 5)):
        broken = STEADY_WRENCH.copy()
        broken[BROKEN_TICK, component] = value
        yield WrenchCase(f"{value:+} N".replace("+nan", "nan") + " m" * (component > 2), broken, even, check_refusal)
    yield WrenchCase("1e300 N", STEADY_WRENCH * 1e300, even, check_clamp)
    constant = even.copy()
    constant[RAMP_TICKS] = 0.05
    yield WrenchCase("10 N after a pause of 50 ms", step, constant, check_climb)
    asleep = even.copy()
    asleep[2 * RAMP_TICKS] = 1.0
    yield WrenchCase(
        "1 N held over a pause of 1 s", STEADY_WRENCH, asleep, lambda out, bits: check_fade_in(out, 2 * RAMP_TICKS)
    )


def check_fade_in(out: Array, first: int) -> str:
    """Check that from tick `first` on, force and moment are STEADY_WRENCH times a share that grows linearly to 1."""
    share = np.minimum(np.arange(1, len(out) - first + 1) / RAMP_TICKS, 1.0)
    good = np.allclose(out[first:], share[:, None] * STEADY_WRENCH[first:], rtol=0.0, atol=ROUNDING)
    return "" if good else "the force did not fade in"


def check_climb(out: Array, bits: NDArray[np.int64]) -> str:
    """Check that 10 N are reached in five steps of 2 N."""
    expected = 2.0 * np.arange(1, 6)
    good = np.allclose(np.linalg.norm(out[RAMP_TICKS : RAMP_TICKS + 5, :3], axis=1), expected, rtol=ROUNDING)
    return "" if good else "the force did not come in steps of the slew limit"


def check_clamp(out: Array, bits: NDArray[np.int64]) -> str:
    good = np.allclose(out[-1], [7.2, 0.0, 9.6, 0.0, 0.3, 0.0], rtol=ROUNDING)  # 12 N, 0.3 N m, as STEADY_WRENCH points
    return "" if good else "the limit was not reached, or the direction lost"


def check_refusal(out: Array, bits: NDArray[np.int64]) -> str:
    at = BROKEN_TICK
    if out[at].any() or bits[at] != NOT_FINITE or (np.delete(bits, at) & NOT_FINITE).any():
        return "a wrench that is not finite was not refused, or not named"
    return check_fade_in(out, at + 1)


def find_violation(out: Array) -> str:
    """Return the rule that the output violates: it is not finite, above a clamp, or jumps other than to zero."""
    if not np.isfinite(out).all():
        return "a wrench that is not finite was commanded"
    for part, largest, slew, part_name in ((out[:, :3], 12.0, 2.0, "force"), (out[:, 3:], 0.3, 0.05, "moment")):
        size = np.linalg.norm(part, axis=1)
        change = np.linalg.norm(np.diff(part, axis=0, prepend=0.0), axis=1)
        if size.max() > largest * (1.0 + ROUNDING):
            return f"a {part_name} past its limit"
        if np.minimum(change, size).max() > slew * (1.0 + ROUNDING):
            return f"a {part_name} that jumped"
    return ""


def try_wrenches() -> Iterator[tuple[str, int, float, str, str]]:
    """Yield for each case its input, ticks, largest force (N), names of guard bits, and the fault."""
    for case in iter_cases():
        out, bits = np.zeros((TICKS, 6)), np.zeros(TICKS, np.int64)
        guard_many(LIMITS, case.wrenches, case.dts, T, out, bits)
        every = int(np.bitwise_or.reduce(bits))
        names = " ".join(name for n, name in enumerate(GUARD_NAMES) if every >> n & 1)
        force = float(np.linalg.norm(out[:, :3], axis=1).max())
        yield case.given, TICKS, force, names, find_violation(out) or case.expects(out, bits)
