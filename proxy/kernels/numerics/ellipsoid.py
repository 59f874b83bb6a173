"""Projection of a point onto an ellipsoid by a Lagrange multiplier, for the limits of friction.

Points are scaled by the semi-axes: y are the components divided by them, and |y| = 1 is the surface. With the squared
distance of component i weighted by 1/w_i, the nearest point has the components y_i / (1 + w_i m), where the multiplier
m >= 0 puts them on the surface. In this metric, the displacement from y to that point is along the surface normal.
"""

from math import sqrt

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

MAX_ITERATIONS = 32
"""Limit of Newton's iterations: two or three are enough near the surface, fifteen for weights 1e24 apart."""
SURFACE_TOLERANCE = 4e-16
"""Distance outside the surface, in semi-axes, below which a point counts as on it."""
LAST_STEP_DISTANCE = 1e-9
"""Distance outside the surface, in semi-axes, below which the next Newton step is the last. The method never
oversteps, so the remaining error is smaller. It is rounding, except if components that hardly change with m are just
inside the surface by themselves."""
MAX_DISTANCE = 1e8
"""Points farther out, in semi-axes, are first scaled to this distance, where only the direction matters, so that
squares remain finite."""


@jit
def shrink(y: Vec3, weight: Vec3, m: float) -> Vec3:
    """Return the scaled components of the point for the multiplier m, scaled down if they are outside the surface."""
    p = (y[0] / (1.0 + weight[0] * m), y[1] / (1.0 + weight[1] * m), y[2] / (1.0 + weight[2] * m))
    size = vec3.norm(p)
    if size > 1.0:
        return vec3.scale(1.0 / size, p)
    return p


@jit
def limit_distance(y: Vec3) -> Vec3:
    """Return `y`, scaled down to MAX_DISTANCE if a component exceeds it, so that its square is finite."""
    largest = max(abs(y[0]), abs(y[1]), abs(y[2]))
    if largest > MAX_DISTANCE:
        return vec3.scale(MAX_DISTANCE / largest, y)
    return y


@jit
def multiplier(y: Vec3, weight: Vec3) -> float:
    """Return the multiplier m >= 0 of the nearest point; 0 if `y` is not outside.

    y        (3,)  components over the semi-axes, magnitude at most about MAX_DISTANCE (see `limit_distance`)
    weight   (3,)  positive

    Newton's method on 1 / |p(m)| = 1, which is concave in m and almost straight: from m = 0 it never oversteps, and a
    ball takes one iteration. Known from trust regions (More and Sorensen, 1983).
    """
    m = 0.0
    for _ in range(MAX_ITERATIONS):
        d0, d1, d2 = 1.0 / (1.0 + weight[0] * m), 1.0 / (1.0 + weight[1] * m), 1.0 / (1.0 + weight[2] * m)
        p0, p1, p2 = y[0] * d0, y[1] * d1, y[2] * d2
        p0, p1, p2 = p0 * p0, p1 * p1, p2 * p2
        square = p0 + p1 + p2
        size = sqrt(square)
        if size <= 1.0 + SURFACE_TOLERANCE:
            break
        # Convergence is quadratic: `shrink` removes the error that remains after one more step, without another check.
        last = size < 1.0 + LAST_STEP_DISTANCE
        slope = weight[0] * d0 * p0 + weight[1] * d1 * p1 + weight[2] * d2 * p2
        m += (size - 1.0) * square / slope
        if last:
            break
    return m
