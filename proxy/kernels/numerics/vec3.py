"""Vectors in space as 3-tuples of float64, which the compiler puts into registers: no allocation."""

from math import sqrt

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3


@jit
def add(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@jit
def sub(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@jit
def scale(s: float, a: Vec3) -> Vec3:
    return (s * a[0], s * a[1], s * a[2])


@jit
def add_scaled(a: Vec3, s: float, b: Vec3) -> Vec3:
    """Return a + s b."""
    return (a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


@jit
def weighted_sum(weights: Vec3, a: Vec3, b: Vec3, c: Vec3) -> Vec3:
    return add_scaled(add_scaled(scale(weights[0], a), weights[1], b), weights[2], c)


MIN_COMPONENT = 1e-300
"""Smaller components of a decaying vector become 0. A tick with a denormal number (below 2e-308) takes 1.3 to 2 times
as long."""


@jit
def scale_and_flush(s: float, a: Vec3) -> Vec3:
    """Return s a, with 0 for components of `a` below MIN_COMPONENT.

    A component that decays by a factor in each tick would otherwise become denormal and remain so. A single branch,
    which the processor predicts, rather than three selects: the tick waits for this value.
    """
    if abs(a[0]) < MIN_COMPONENT or abs(a[1]) < MIN_COMPONENT or abs(a[2]) < MIN_COMPONENT:
        return (
            0.0 if abs(a[0]) < MIN_COMPONENT else s * a[0],
            0.0 if abs(a[1]) < MIN_COMPONENT else s * a[1],
            0.0 if abs(a[2]) < MIN_COMPONENT else s * a[2],
        )
    return scale(s, a)


@jit
def dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@jit
def norm(a: Vec3) -> float:
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@jit
def reject(a: Vec3, n: Vec3) -> Vec3:
    """Return the component of `a` normal to the unit vector `n`."""
    return add_scaled(a, -dot(a, n), n)
