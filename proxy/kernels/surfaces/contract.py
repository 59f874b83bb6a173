"""What every shape can do, and the parts that most of them share.

    closest(shape, x)                        -> gap, point, normal  of the surface point nearest to x
    curvature(shape, radius, point, normal)  -> k1, k2, d1          of the surface the fingertip's centre moves on
    transport(shape, v, n_from, n_to)        -> (3,)                tangent vector v carried to the new normal

All in the frame of the shape, for any x within 1e100 m. `gap` is the signed distance, m, positive where the fingertip
may be, and `normal` the unit normal that points there. `curvature` is that of the offset surface, a distance `radius`
from the shape: with k of the shape itself it is k / (1 + radius k), finite on a sharp edge too. k1 and k2, 1/m, are
principal, positive where the surface bulges towards the fingertip; d1 is the unit tangent of k1, and normal x d1 that
of k2.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Vec3

X_AXIS: Vec3 = (1.0, 0.0, 0.0)
Y_AXIS: Vec3 = (0.0, 1.0, 0.0)
Z_AXIS: Vec3 = (0.0, 0.0, 1.0)

FAN = 1e-9
"""A component of a normal below this is none: rotating the normal out of the world and back leaves 1e-16."""


@by_type
def closest(shape: Any, x: Vec3) -> Any: ...


@by_type
def curvature(shape: Any, radius: float, point: Vec3, normal: Vec3) -> Any: ...


@by_type
def transport(shape: Any, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Any: ...


@jit
def direction(v: Vec3, otherwise: Vec3) -> tuple[float, Vec3]:
    """Length of `v` and the unit vector along it; `otherwise` where `v` is zero. Any finite `v` will do."""
    square = vec3.dot(v, v)
    if 1e-250 < square < 1e250:
        length = sqrt(square)
        return length, vec3.scale(1.0 / length, v)
    largest = max(abs(v[0]), abs(v[1]), abs(v[2]))
    if largest == 0.0:
        return 0.0, otherwise
    shape = (v[0] / largest, v[1] / largest, v[2] / largest)
    length = vec3.norm(shape)
    return largest * length, vec3.scale(1.0 / length, shape)


@jit
def around_z(normal: Vec3) -> Vec3:
    """Unit tangent that goes round the z axis, counter-clockwise; x where the normal is along the axis."""
    length = sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    if length <= FAN:
        return X_AXIS
    return (-normal[1] / length, normal[0] / length, 0.0)


@jit
def any_tangent(normal: Vec3) -> Vec3:
    """Some unit vector at right angles to the unit vector `normal`, without a difference of close numbers."""
    if abs(normal[1]) <= 0.8:
        length = sqrt(normal[0] * normal[0] + normal[2] * normal[2])
        return (normal[2] / length, 0.0, -normal[0] / length)
    length = sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    return (normal[1] / length, -normal[0] / length, 0.0)


@jit
def offset(k: float, radius: float) -> float:
    """Curvature at a distance `radius` from a surface of curvature `k`, 1/m.

    A fingertip that fits has 1 + radius k > 0; what does not fit gets a large curvature, not an infinite one.
    """
    return k / max(1.0 + radius * k, 1e-9)


@jit
def turn_along(v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """`v` turned by the smallest rotation that takes one unit normal to the other.

    As two reflections, the first at the plane half way: the length of a tangent `v` is kept to rounding however far
    the normal turns. Opposite normals have no smallest rotation; half a turn about a fixed tangent serves.
    """
    middle = vec3.add(normal_from, normal_to)
    square = vec3.dot(middle, middle)
    if square < 1e-28:
        middle, square = any_tangent(normal_from), 1.0
    # One division for all vectors that are carried between the same two normals.
    flipped = vec3.add_scaled(v, (-2.0 / square) * vec3.dot(middle, v), middle)
    return vec3.add_scaled(flipped, 2.0 * vec3.dot(normal_from, v), normal_to)
