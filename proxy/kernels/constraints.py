"""The smallest displacement that satisfies up to three half-spaces at once.

This is the whole of the multi-contact solve: the proxy is the point nearest the probe that satisfies
every constraint, so the displacement from the probe is a combination of at most three normals with
weights that are not negative. All sets of one to three normals are tried; there are seven.
"""

from typing import NamedTuple

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Vec3

PARALLEL = 1e-9
"""Squared sine below which two normals count as one."""
SLACK = 1e-12
"""Share of the largest demand by which a constraint may be missed: rounding of the solve."""


class Push(NamedTuple):
    """Weights of the three normals, not negative; the displacement is their combination."""

    first: float
    second: float
    third: float


@jit
def displacement(push: Push, n1: Vec3, n2: Vec3, n3: Vec3) -> Vec3:
    """first n1 + second n2 + third n3."""
    return vec3.add_scaled(vec3.add_scaled(vec3.scale(push.first, n1), push.second, n2), push.third, n3)


@jit
def _misses(push: Push, n1: Vec3, n2: Vec3, n3: Vec3, b1: float, b2: float, b3: float, slack: float) -> bool:
    if not (push.first >= 0.0 and push.second >= 0.0 and push.third >= 0.0):
        return True
    d = displacement(push, n1, n2, n3)
    return vec3.dot(n1, d) < b1 - slack or vec3.dot(n2, d) < b2 - slack or vec3.dot(n3, d) < b3 - slack


@jit
def _pair(c: float, b1: float, b2: float) -> tuple[float, float]:
    """Weights that meet two demands exactly; `c` is the cosine between the normals."""
    scale = 1.0 / (1.0 - c * c)
    return (b1 - c * b2) * scale, (b2 - c * b1) * scale


@jit
def smallest_push(count: int, n1: Vec3, n2: Vec3, n3: Vec3, b1: float, b2: float, b3: float) -> Push:
    """Weights of the smallest d with n_i . d >= b_i for the first `count` unit normals (1 to 3).

    The first set of normals whose exact solution has no negative weight and satisfies the others is the
    answer, since the problem is convex. Where demands contradict each other beyond rounding, the single
    strongest one is met.
    """
    single = Push(max(b1, 0.0), 0.0, 0.0)
    if count == 1:
        return single
    if count == 2:
        n3, b3 = n2, b2
    slack = SLACK * (abs(b1) + abs(b2) + abs(b3))
    # All of them together first: it is what holds a proxy that rests, and then nothing else has to be tried.
    c12, c13, c23 = vec3.dot(n1, n2), vec3.dot(n1, n3), vec3.dot(n2, n3)
    if count == 3:
        # Cramer's rule on the Gram matrix.
        volume = 1.0 + 2.0 * c12 * c13 * c23 - c12 * c12 - c13 * c13 - c23 * c23
        if volume > PARALLEL:
            scale = 1.0 / volume
            push = Push(
                scale * (b1 * (1.0 - c23 * c23) - b2 * (c12 - c13 * c23) - b3 * (c13 - c12 * c23)),
                scale * (b2 * (1.0 - c13 * c13) - b1 * (c12 - c13 * c23) - b3 * (c23 - c12 * c13)),
                scale * (b3 * (1.0 - c12 * c12) - b1 * (c13 - c12 * c23) - b2 * (c23 - c12 * c13)),
            )
            if push.first >= 0.0 and push.second >= 0.0 and push.third >= 0.0:
                return push
    if 1.0 - c12 * c12 > PARALLEL:
        one, two = _pair(c12, b1, b2)
        push = Push(one, two, 0.0)
        if not _misses(push, n1, n2, n3, b1, b2, b3, slack):
            return push
    if count == 3:
        if 1.0 - c13 * c13 > PARALLEL:
            one, three = _pair(c13, b1, b3)
            push = Push(one, 0.0, three)
            if not _misses(push, n1, n2, n3, b1, b2, b3, slack):
                return push
        if 1.0 - c23 * c23 > PARALLEL:
            two, three = _pair(c23, b2, b3)
            push = Push(0.0, two, three)
            if not _misses(push, n1, n2, n3, b1, b2, b3, slack):
                return push
    if not _misses(single, n1, n2, n3, b1, b2, b3, slack):
        return single
    push = Push(0.0, max(b2, 0.0), 0.0)
    if not _misses(push, n1, n2, n3, b1, b2, b3, slack):
        return push
    if count == 3:
        push = Push(0.0, 0.0, max(b3, 0.0))
        if not _misses(push, n1, n2, n3, b1, b2, b3, slack):
            return push
    if b2 > b1 and (count == 2 or b2 >= b3):
        return Push(0.0, max(b2, 0.0), 0.0)
    if count == 3 and b3 > b1:
        return Push(0.0, 0.0, max(b3, 0.0))
    return single
