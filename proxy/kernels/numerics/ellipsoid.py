"""The nearest point of an ellipsoid to a point outside, by its Lagrange multiplier.

A point is given by its components over the semi-axes, y, so that |y| = 1 is the surface. The nearest
point, distance weighted by 1/w_i for component i, has the components y_i / (1 + w_i m) with the multiplier
m >= 0 for which they are on the surface; the way back is then along the surface's normal.
"""

from math import sqrt

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

ITERATIONS = 32
"""Bound of Newton's method; near the surface two or three do, at weights 1e24 apart fifteen."""
CONVERGED = 4e-16
"""How far outside the surface, in semi-axes, is on it."""
LAST_STEP = 1e-9
"""How far outside the surface a step of Newton's method is the last. It never oversteps, so what is left is less; it is
rounding, but where components that hardly change beside others are just inside the surface by themselves."""
FARTHEST = 1e8
"""Points farther out, in semi-axes, are brought here first: squares stay finite, and only the direction counts."""


@jit
def shrink(y: Vec3, weight: Vec3, m: float) -> Vec3:
    """Components of the point that the multiplier m belongs to, none of it outside the surface."""
    p = (y[0] / (1.0 + weight[0] * m), y[1] / (1.0 + weight[1] * m), y[2] / (1.0 + weight[2] * m))
    size = vec3.norm(p)
    if size > 1.0:
        return vec3.scale(1.0 / size, p)
    return p


@jit
def near(y: Vec3) -> Vec3:
    """`y`, or a point in its direction near enough to be squared."""
    largest = max(abs(y[0]), abs(y[1]), abs(y[2]))
    if largest > FARTHEST:
        return vec3.scale(FARTHEST / largest, y)
    return y


@jit
def multiplier(y: Vec3, weight: Vec3) -> float:
    """Multiplier m >= 0 of the nearest point; 0 for a point that is not outside.

    y        (3,)  components over the semi-axes, magnitude at most about FARTHEST (see `near`)
    weight   (3,)  positive

    Newton's method on 1 / |p(m)| = 1, which is concave in m and almost straight: from m = 0 it never
    oversteps, and a ball takes one iteration. Known from trust regions (More and Sorensen, 1983).
    """
    m = 0.0
    for _ in range(ITERATIONS):
        d0, d1, d2 = 1.0 / (1.0 + weight[0] * m), 1.0 / (1.0 + weight[1] * m), 1.0 / (1.0 + weight[2] * m)
        p0, p1, p2 = y[0] * d0, y[1] * d1, y[2] * d2
        p0, p1, p2 = p0 * p0, p1 * p1, p2 * p2
        square = p0 + p1 + p2
        size = sqrt(square)
        if size <= 1.0 + CONVERGED:
            break
        # The error is squared: what one more step leaves, `shrink` takes off, and it need not be looked at.
        last = size < 1.0 + LAST_STEP
        slope = weight[0] * d0 * p0 + weight[1] * d1 * p1 + weight[2] * d2 * p2
        m += (size - 1.0) * square / slope
        if last:
            break
    return m
