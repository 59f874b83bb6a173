"""Smallest displacement that satisfies up to three half-space constraints.

This solves the contact with several objects, unless they leave no room: the proxy is the point closest to the probe
that satisfies every constraint, so its displacement from the probe is a combination of at most three normals with
non-negative weights. The solver tries all seven active sets of one to three normals.
"""

from math import sqrt
from typing import NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

PARALLEL_SQUARED_SINE = 1e-9
"""Squared sine of the angle between two normals below which they count as one."""
DEMAND_TOLERANCE = 1e-12
"""Violation of a constraint that counts as rounding of the solve, as a share of the demands' sum."""
FACING_COSINE = -0.98
"""Cosine between two normals below which their walls face each other (at most 11 degrees from parallel). The fingertip
is then pinched between them, not pushed out of the wedge: a friction coefficient of 0.1 is enough to hold it."""


class Cosines(NamedTuple):
    """Cosines of the angles between the three normals."""

    c12: float
    c13: float
    c23: float


@jit
def _violates(push: Vec3, c: Cosines, b1: float, b2: float, b3: float, slack: float) -> bool:
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
    """Return the weights that satisfy two demands with equality; `c` is the cosine between the normals.

    The first weight is computed from the second: with nearly parallel normals the weights have few correct digits, but
    the weighted sum has nearly all.
    """
    two = (b2 - c * b1) / (1.0 - c * c)
    return b1 - c * two, two


@jit
def _solve(count: int, c: Cosines, b1: float, b2: float, b3: float) -> tuple[Vec3, bool]:
    """Return the weights, m, of the first active set that has no negative weight and satisfies all demands, and True.

    The problem is convex, so that set is the solution. False if no set satisfies them. With `count` 2, the third
    normal and demand are copies of the second.
    """
    slack = DEMAND_TOLERANCE * (abs(b1) + abs(b2) + abs(b3))
    # The full set first: it is the active set of a proxy at rest, and no other has to be tried then.
    c12, c13, c23 = c
    if count == 3:
        # Cramer's rule on the Gram matrix.
        volume = 1.0 + 2.0 * c12 * c13 * c23 - c12 * c12 - c13 * c13 - c23 * c23
        if volume > PARALLEL_SQUARED_SINE:
            scale = 1.0 / volume
            push = (
                scale * (b1 * (1.0 - c23 * c23) - b2 * (c12 - c13 * c23) - b3 * (c13 - c12 * c23)),
                scale * (b2 * (1.0 - c13 * c13) - b1 * (c12 - c13 * c23) - b3 * (c23 - c12 * c13)),
                scale * (b3 * (1.0 - c12 * c12) - b1 * (c13 - c12 * c23) - b2 * (c23 - c12 * c13)),
            )
            if push[0] >= 0.0 and push[1] >= 0.0 and push[2] >= 0.0:
                return push, True
    if 1.0 - c12 * c12 > PARALLEL_SQUARED_SINE:
        one, two = _pair(c12, b1, b2)
        push = (one, two, 0.0)
        if not _violates(push, c, b1, b2, b3, slack):
            return push, True
    if count == 3:
        if 1.0 - c13 * c13 > PARALLEL_SQUARED_SINE:
            one, three = _pair(c13, b1, b3)
            push = (one, 0.0, three)
            if not _violates(push, c, b1, b2, b3, slack):
                return push, True
        if 1.0 - c23 * c23 > PARALLEL_SQUARED_SINE:
            two, three = _pair(c23, b2, b3)
            push = (0.0, two, three)
            if not _violates(push, c, b1, b2, b3, slack):
                return push, True
    # A single normal is enough only if its demand is the largest. With nearly parallel normals, another one would be
    # within rounding, too, but its push would be tilted.
    push = (max(b1, 0.0), 0.0, 0.0)
    if b2 > b1:
        push = (0.0, max(b2, 0.0), 0.0)
    if count == 3 and b3 > max(b1, b2):
        push = (0.0, 0.0, max(b3, 0.0))
    return push, not _violates(push, c, b1, b2, b3, slack)


class HalfSpaceSolution(NamedTuple):
    """Loads of the constraints, and the displacement of the proxy.

    push     (3,) m  depth that the spring of each constraint bears
    weights  (3,) m  of the normals; their weighted sum is the displacement from probe to proxy. Equal to
                     `push` unless pinched
    """

    push: Vec3
    weights: Vec3


@jit
def _weights_between(c: float, first: float, second: float, b1: float, b2: float) -> tuple[float, float]:
    """Return the weights of two normals: halfway between walls that face each other and leave no room."""
    if c < FACING_COSINE and b1 + b2 > 0.0:
        return 0.5 * b1, 0.5 * b2
    return first, second


@jit
def _ease_demands(c: float, b1: float, b2: float) -> tuple[float, float]:
    """Return two demands, the smaller reduced until the larger also satisfies it if their normals are nearly parallel.

    `c` is the cosine between the normals.
    """
    if c < 0.0 or 1.0 - c * c > PARALLEL_SQUARED_SINE:
        return b1, b2
    if b1 >= b2:
        return b1, min(b2, b1 - PARALLEL_SQUARED_SINE * abs(b1))
    return min(b1, b2 - PARALLEL_SQUARED_SINE * abs(b2)), b2


@jit
def solve_half_spaces(count: int, n1: Vec3, n2: Vec3, n3: Vec3, b1: float, b2: float, b3: float) -> HalfSpaceSolution:
    """Return the weights of the smallest displacement d with n_i . d >= b_i (m), for 1 to 3 unit normals.

    count  number of constraints; further normals and demands are ignored

    Two walls that face each other and leave no room each bear the depth of the probe in them, and the proxy is halfway
    between them. Three walls that enclose it, no two of them facing, leave it inside each by the same depth t: each
    bears t plus its weight in the smallest push for the demands b_i - t. As t approaches 0, so does the difference from
    the push of constraints that can be satisfied.
    """
    single = (max(b1, 0.0), 0.0, 0.0)
    if count == 1:
        return HalfSpaceSolution(single, single)
    if count == 2:
        n3, b3 = n2, b2
    true = Cosines(vec3.dot(n1, n2), vec3.dot(n1, n3), vec3.dot(n2, n3))
    # Of two walls that face each other, neither bears any of the other's load.
    c12, c13 = 0.0 if true.c12 < FACING_COSINE else true.c12, 0.0 if true.c13 < FACING_COSINE else true.c13
    c = Cosines(c12, c13, 0.0 if true.c23 < FACING_COSINE else true.c23)
    push, is_satisfied = _solve(count, c, b1, b2, b3)
    if not is_satisfied:  # the larger demand of two nearly parallel normals satisfies both
        one, two = _ease_demands(c.c12, b1, b2)
        one, three = _ease_demands(c.c13, one, b3)
        two, three = _ease_demands(c.c23, two, three)
        push, is_satisfied = _solve(count, c, one, two, three)
    if not is_satisfied:
        # The normals are coplanar, sum nu_i n_i = 0; the demands b_i - t can be satisfied if sum nu_i (b_i - t) = 0.
        v1, v2, v3 = sqrt(1.0 - c.c23 * c.c23), sqrt(1.0 - c.c13 * c.c13), sqrt(1.0 - c.c12 * c.c12)
        t = (v1 * b1 + v2 * b2 + v3 * b3) / (v1 + v2 + v3)
        weights, _ = _solve(count, c, b1 - t, b2 - t, b3 - t)
        return HalfSpaceSolution((weights[0] + t, weights[1] + t, weights[2] + t), weights)
    one, two = _weights_between(true.c12, push[0], push[1], b1, b2)
    three = push[2]
    if count == 3:
        one, three = _weights_between(true.c13, one, three, b1, b3)
        two, three = _weights_between(true.c23, two, three, b2, b3)
    return HalfSpaceSolution(push, (one, two, three))
