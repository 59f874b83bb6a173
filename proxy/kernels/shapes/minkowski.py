"""Minkowski sums: surfaces as the centre of an ellipsoidal fingertip sees them.

An ellipsoid of the semi-axes a_i along the columns of Q has the matrix E = Q diag(a_i^2) Q^T and the support
h(n) = sqrt(n . E n). Where the object's normal is n, the fingertip touches with its own normal -n, and its centre is
E n / h(n) beyond the point of contact (`support_vector`). So the centre moves on the border of the Minkowski sum of
object and ellipsoid, as that of a ball moves on the offset surface. `closest` is about the surface that lies `radius`
behind this border. From the centre it looks as if a ball of that radius touched it, so a query for the nearest point
needs no case of its own.

No iteration of its own is needed, as the sum is

    plane     a plane, h(n) farther out
    sphere    the ellipsoid, and a ball's radius farther out: nearest is what is nearest on the ellipsoid
    cylinder  across the axis the same with the ellipsoid's shadow, an ellipse; along it nothing changes

The nearest point of the ellipsoid is found to rounding, see `ellipsoid`. Other surfaces are refused by the scene.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Cylinder, Ellipsoid, MinkowskiSum, Plane, Quaternion, Sphere, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes.ellipsoid import closest_on_ellipsoid, times
from softfinger.proxy.kernels.shapes.protocol import X_AXIS, Y_AXIS, Z_AXIS, closest, curvature, direction


@by_type
def nearest_on_minkowski_sum(shape: Any, grown: MinkowskiSum, x: Vec3) -> Any:
    """Gap (m), centre (3,) m and normal (3,) of the place of a fingertip on the shape that is nearest to x."""


@jit
def support_vector(semi_axes: Vec3, orientation: Quaternion, normal: Vec3) -> Vec3:
    """From the point of contact to the ellipsoid's centre (3,) m: E n / h(n).

    semi_axes    (3,)  m
    orientation  (4,)     of its axes in the frame of `normal`
    normal       (3,)     unit, of the object
    """
    scaled = times(semi_axes, rotations.rotate(rotations.conjugate(orientation), normal))
    return rotations.rotate(orientation, vec3.scale(1.0 / vec3.norm(scaled), times(semi_axes, scaled)))


@nearest_on_minkowski_sum.of(Plane)
def nearest_over_plane(shape: Plane, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    support = vec3.dot(shape.normal, support_vector(grown.semi_axes, grown.orientation, shape.normal))
    gap = vec3.dot(shape.normal, x) - shape.offset - support
    return gap, vec3.add_scaled(x, -gap, shape.normal), shape.normal


@nearest_on_minkowski_sum.of(Sphere)
def nearest_over_sphere(shape: Sphere, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """An ellipsoid is its own image in its centre: the sphere's centre is as far from it as it is from the sphere's."""
    local = rotations.rotate(rotations.conjugate(grown.orientation), x)
    gap, point, normal = closest_on_ellipsoid(Ellipsoid(grown.semi_axes, 1.0), local)
    center = rotations.rotate(grown.orientation, vec3.add_scaled(point, shape.radius, normal))
    return gap - shape.radius, center, rotations.rotate(grown.orientation, normal)


@nearest_on_minkowski_sum.of(Cylinder)
def nearest_over_cylinder(shape: Cylinder, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """The shadow along z has the matrix of the first two rows and columns of E, a Gram matrix; the product of its
    eigenvalues is a sum of squares by the formula of Cauchy and Binet, and no difference of close numbers."""
    a, back = grown.semi_axes, rotations.conjugate(grown.orientation)
    u, v = times(a, rotations.rotate(back, X_AXIS)), times(a, rotations.rotate(back, Y_AXIS))
    uu, vv, uv = vec3.dot(u, u), vec3.dot(v, v), vec3.dot(u, v)
    half = 0.5 * (uu - vv)
    spread = sqrt(half * half + uv * uv)
    longest = sqrt(0.5 * (uu + vv) + spread)
    area = vec3.norm(times((a[1] * a[2], a[2] * a[0], a[0] * a[1]), rotations.rotate(back, Z_AXIS)))
    along = (half + spread, uv, 0.0) if half >= 0.0 else (uv, spread - half, 0.0)
    _, turned = direction(along, X_AXIS)
    c, s = turned[0], turned[1]
    # The third axis takes no part: the point lies in the plane across it.
    shadow = Ellipsoid((longest, area / longest, longest), 1.0)
    gap, point, normal = closest_on_ellipsoid(shadow, (c * x[0] + s * x[1], c * x[1] - s * x[0], 0.0))
    n = (c * normal[0] - s * normal[1], s * normal[0] + c * normal[1], 0.0)
    center = (c * point[0] - s * point[1], s * point[0] + c * point[1], x[2])
    return gap - shape.radius, vec3.add_scaled(center, shape.radius, n), n


@closest.of(MinkowskiSum)
def closest_on_minkowski_sum(shape: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    gap, center, normal = nearest_on_minkowski_sum(shape.shape, shape, x)
    return gap + shape.radius, vec3.add_scaled(center, -shape.radius, normal), normal


@curvature.of(MinkowskiSum)
def curvature_of_minkowski_sum(
    shape: MinkowskiSum, radius: float, point: Vec3, normal: Vec3
) -> tuple[float, float, Vec3]:
    """W = (1 + W_o S)^-1 W_o along tangents u, v: W_o of the object, S = E / h - E n (E n)^T / h^3 of the fingertip.

    Both add to how far the centre goes while the normal turns. Source: Schneider, Convex Bodies, section 2.5.
    """
    ku, kv, u = curvature(shape.shape, 0.0, point, normal)
    v = vec3.cross(normal, u)
    back, a = rotations.conjugate(shape.orientation), shape.semi_axes
    n = times(a, rotations.rotate(back, normal))
    p, q = times(a, rotations.rotate(back, u)), times(a, rotations.rotate(back, v))
    h = vec3.norm(n)
    along, across = vec3.dot(n, p) / h, vec3.dot(n, q) / h
    uu, vv = (vec3.dot(p, p) - along * along) / h, (vec3.dot(q, q) - across * across) / h
    uv = (vec3.dot(p, q) - along * across) / h
    size = (1.0 + ku * uu) * (1.0 + kv * vv) - ku * kv * uv * uv
    first, second, mixed = ku * (1.0 + kv * vv) / size, kv * (1.0 + ku * uu) / size, -ku * kv * uv / size
    half, mean = 0.5 * (first - second), 0.5 * (first + second)
    spread = sqrt(half * half + mixed * mixed)
    _, turned = direction((half + spread, mixed, 0.0) if half >= 0.0 else (mixed, spread - half, 0.0), X_AXIS)
    return mean + spread, mean - spread, vec3.add_scaled(vec3.scale(turned[0], u), turned[1], v)
