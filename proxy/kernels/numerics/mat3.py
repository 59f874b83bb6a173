"""Matrices (3, 3) as tuples of rows."""

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

Mat3 = tuple[Vec3, Vec3, Vec3]
ZEROS: Mat3 = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
IDENTITY: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@jit
def times(m: Mat3, v: Vec3) -> Vec3:
    return (vec3.dot(m[0], v), vec3.dot(m[1], v), vec3.dot(m[2], v))


@jit
def transpose(m: Mat3) -> Mat3:
    return ((m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2]))


@jit
def plus(a: Mat3, s: float, b: Mat3) -> Mat3:
    """Return a + s b."""
    return (vec3.add_scaled(a[0], s, b[0]), vec3.add_scaled(a[1], s, b[1]), vec3.add_scaled(a[2], s, b[2]))


@jit
def product(a: Mat3, b: Mat3) -> Mat3:
    columns = transpose(b)
    return (times(columns, a[0]), times(columns, a[1]), times(columns, a[2]))


@jit
def plus_outer(m: Mat3, a: Vec3, b: Vec3) -> Mat3:
    """Return m + a b^T."""
    return (vec3.add_scaled(m[0], a[0], b), vec3.add_scaled(m[1], a[1], b), vec3.add_scaled(m[2], a[2], b))


@jit
def inverse(m: Mat3) -> Mat3:
    a, b, c = vec3.cross(m[1], m[2]), vec3.cross(m[2], m[0]), vec3.cross(m[0], m[1])
    size = 1.0 / vec3.dot(m[0], a)
    return transpose((vec3.scale(size, a), vec3.scale(size, b), vec3.scale(size, c)))
