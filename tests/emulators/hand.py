"""What a hand means to do with an emulated device."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi

Vector = tuple[float, float, float]


def stroke(place: Vector, press: float, drag: float) -> Callable[[float], Vector]:
    """From `place` down by `press` m in 0.3 s, along x by `drag` m and back in 0.6 s, up in 0.3 s, and again."""

    def smooth(share: float) -> float:
        return 0.5 - 0.5 * cos(pi * min(max(share, 0.0), 1.0))

    def at(time_s: float) -> Vector:
        t = time_s % 1.2
        depth = smooth(t / 0.3) - smooth((t - 0.9) / 0.3)
        side = smooth((t - 0.3) / 0.3) - smooth((t - 0.6) / 0.3)
        return (place[0] + drag * side, place[1], place[2] - press * depth)

    return at
