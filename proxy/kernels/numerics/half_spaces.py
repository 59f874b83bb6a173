"""The smallest displacement that satisfies up to three half-spaces at once.

This is the whole of the multi-contact solve where bodies leave room: the proxy is the point nearest the probe that
satisfies every constraint, so the displacement from the probe is a combination of at most three normals with weights
that are not negative. All sets of one to three normals are tried; there are seven.
"""

from math import sqrt
from typing import NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

PARALLEL = 1e-9
"""Squared sine below which two normals count as one."""
SLACK = 1e-12
"""Share of the largest demand by which a constraint may be missed: rounding of the solve."""
FACING = -0.98
"""Cosine between two normals below which the walls face each other, 11 degrees from parallel at the most. Between them
a fingertip is pinched, not pushed out of the wedge: friction holds it there from a coefficient of 0.1 on."""


class Depths(NamedTuple):
    """Weights of the three normals, not negative; the displacement is their combination."""

    first: float
    second: float
    third: float


@jit
def displacement(push: Depths, n1: Vec3, n2: Vec3, n3: Vec3) -> Vec3:
    """first n1 + second n2 + third n3."""
    return vec3.add_scaled(vec3.add_scaled(vec3.scale(push.first, n1), push.second, n2), push.third, n3)


class Cosines(NamedTuple):
    """Between the three normals."""

    c12: float
    c13: float
    c23: float


@jit
def cosines(n1: Vec3, n2: Vec3, n3: Vec3) -> Cosines:
    return Cosines(vec3.dot(n1, n2), vec3.dot(n1, n3), vec3.dot(n2, n3))


@jit
def _misses(push: Depths, c: Cosines, b1: float, b2: float, b3: float, slack: float) -> bool:
    one, two, three = push
    if not (one >= 0.0 and two >= 0.0 and three >= 0.0):
        return True
    return (
        one + c.c12 * two + c.c13 * three < b1 - slack
        or c.c12 * one + two + c.c23 * three < b2 - slack
        or c.c13 * one + c.c23 * two + three < b3 - slack
    )


@jit
def _pair(c: float, b1: float, b2: float) -> tuple[float, float]:
    """Weights that meet two demands exactly; `c` is the cosine between the normals.

    The first by what the second leaves of it: nearly parallel normals have weights of few digits, and a sum of many.
    """
    two = (b2 - c * b1) / (1.0 - c * c)
    return b1 - c * two, two


@jit
def _meet(count: int, c: Cosines, b1: float, b2: float, b3: float) -> tuple[Depths, bool]:
    """The first set of normals whose exact solution has no negative weight and satisfies the others; False for none.

    The problem is convex, so it is the answer. With two, the third is a copy of the second.
    """
    slack = SLACK * (abs(b1) + abs(b2) + abs(b3))
    # All of them together first: it is what holds a proxy that rests, and then nothing else has to be tried.
    c12, c13, c23 = c
    if count == 3:
        # Cramer's rule on the Gram matrix.
        volume = 1.0 + 2.0 * c12 * c13 * c23 - c12 * c12 - c13 * c13 - c23 * c23
        if volume > PARALLEL:
            scale = 1.0 / volume
            push = Depths(
                scale * (b1 * (1.0 - c23 * c23) - b2 * (c12 - c13 * c23) - b3 * (c13 - c12 * c23)),
                scale * (b2 * (1.0 - c13 * c13) - b1 * (c12 - c13 * c23) - b3 * (c23 - c12 * c13)),
                scale * (b3 * (1.0 - c12 * c12) - b1 * (c13 - c12 * c23) - b2 * (c23 - c12 * c13)),
            )
            if push.first >= 0.0 and push.second >= 0.0 and push.third >= 0.0:
                return push, True
    if 1.0 - c12 * c12 > PARALLEL:
        one, two = _pair(c12, b1, b2)
        push = Depths(one, two, 0.0)
        if not _misses(push, c, b1, b2, b3, slack):
            return push, True
    if count == 3:
        if 1.0 - c13 * c13 > PARALLEL:
            one, three = _pair(c13, b1, b3)
            push = Depths(one, 0.0, three)
            if not _misses(push, c, b1, b2, b3, slack):
                return push, True
        if 1.0 - c23 * c23 > PARALLEL:
            two, three = _pair(c23, b2, b3)
            push = Depths(0.0, two, three)
            if not _misses(push, c, b1, b2, b3, slack):
                return push, True
    # Alone only the strongest can do; of nearly parallel ones the others would do too, to rounding, but tilted.
    push = Depths(max(b1, 0.0), 0.0, 0.0)
    if b2 > b1:
        push = Depths(0.0, max(b2, 0.0), 0.0)
    if count == 3 and b3 > max(b1, b2):
        push = Depths(0.0, 0.0, max(b3, 0.0))
    return push, not _misses(push, c, b1, b2, b3, slack)


class Solution(NamedTuple):
    """What constraints do to a proxy: what each of them bears, and where together they put it.

    push     m     depth that each one's spring bears
    place    m     weights of the normals whose combination is the proxy's way from the probe: the push, but in a pinch
    """

    push: Depths
    place: Depths


@jit
def _apart(c: float) -> float:
    """The cosine, 0 between walls that face each other: neither takes load from the other."""
    return 0.0 if c < FACING else c


@jit
def _between(c: float, first: float, second: float, b1: float, b2: float) -> tuple[float, float]:
    """Weights of two of the normals in `place`: half way where walls that face each other leave no room."""
    if c < FACING and b1 + b2 > 0.0:
        return 0.5 * b1, 0.5 * b2
    return first, second


@jit
def _eased(c: float, b1: float, b2: float) -> tuple[float, float]:
    """Two demands, the lesser of them met by the other one where their normals are nearly parallel, c their cosine."""
    if c < 0.0 or 1.0 - c * c > PARALLEL:
        return b1, b2
    if b1 >= b2:
        return b1, min(b2, b1 - PARALLEL * abs(b1))
    return min(b1, b2 - PARALLEL * abs(b2)), b2


@jit
def solve_half_spaces(count: int, n1: Vec3, n2: Vec3, n3: Vec3, b1: float, b2: float, b3: float) -> Solution:
    """Weights of the smallest d with n_i . d >= b_i (m) for the first `count` unit normals (1 to 3); where bodies
    leave no room, springs of their own.

    Walls that face each other bear what the probe is deep in each, and the proxy is half way between them. Three
    that close in on it from all sides, no two of them facing, leave it inside each of them by the same t: they bear
    that and, beside it, what the smallest push with demands b_i - t asks for. Both go over into the push without
    contradiction as t goes to 0.
    """
    single = Depths(max(b1, 0.0), 0.0, 0.0)
    if count == 1:
        return Solution(single, single)
    if count == 2:
        n3, b3 = n2, b2
    true = cosines(n1, n2, n3)
    c = Cosines(_apart(true.c12), _apart(true.c13), _apart(true.c23))
    push, met = _meet(count, c, b1, b2, b3)
    if not met:  # of nearly parallel normals the one that asks for more asks for both
        one, two = _eased(c.c12, b1, b2)
        one, three = _eased(c.c13, one, b3)
        two, three = _eased(c.c23, two, three)
        push, met = _meet(count, c, one, two, three)
    if not met:
        # At t the demands are coplanar with the normals: sum nu_i (b_i - t) = 0 where sum nu_i n_i = 0.
        v1, v2, v3 = sqrt(1.0 - c.c23 * c.c23), sqrt(1.0 - c.c13 * c.c13), sqrt(1.0 - c.c12 * c.c12)
        t = (v1 * b1 + v2 * b2 + v3 * b3) / (v1 + v2 + v3)
        place, _ = _meet(count, c, b1 - t, b2 - t, b3 - t)
        return Solution(Depths(place.first + t, place.second + t, place.third + t), place)
    one, two = _between(true.c12, push.first, push.second, b1, b2)
    three = push.third
    if count == 3:
        one, three = _between(true.c13, one, three, b1, b3)
        two, three = _between(true.c23, two, three, b2, b3)
    return Solution(push, Depths(one, two, three))
