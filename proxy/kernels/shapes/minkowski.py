"""Minkowski sums of an object and an ellipsoidal fingertip: the surfaces on which the fingertip's centre moves.

An ellipsoid with semi-axes a_i along the columns of Q has the matrix E = Q diag(a_i^2) Q^T and the support function
h(n) = sqrt(n . E n). At an object normal n, the fingertip touches with its normal -n, and its centre is displaced from
the contact point by E n / h(n) (`support_vector`). So the centre moves on the boundary of the Minkowski sum of object
and ellipsoid, as the centre of a ball moves on the offset surface. `closest` returns points of the surface `radius`
below this boundary, as if a ball of that radius touched it: queries for the nearest point then need no special case.

The sum has a closed form, up to the nearest point of an ellipsoid:

    plane     a plane, farther out by h(n)
    sphere    the ellipsoid, farther out by the sphere's radius: the same point of the ellipsoid is nearest
    cylinder  normal to the axis, as the sphere but with the ellipsoid's projection, an ellipse; unchanged along it

`ellipsoid` finds the nearest point to rounding. Scenes reject other shapes for this fingertip.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Cylinder, Ellipsoid, MinkowskiSum, Plane, Quaternion, Sphere, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes.ellipsoid import closest_on_ellipsoid, multiply_components
from softfinger.proxy.kernels.shapes.protocol import X_AXIS, Y_AXIS, Z_AXIS, closest, compute_direction, curvature


@by_type
def nearest_on_minkowski_sum(shape: Any, grown: MinkowskiSum, x: Vec3) -> Any:
    """Return gap (m), centre (3,) m and normal (3,) of the fingertip in contact with the shape that is closest to x."""


@jit
def support_vector(semi_axes: Vec3, orientation: Quaternion, normal: Vec3) -> Vec3:
    """Return the displacement (3,) m from the contact point to the ellipsoid's centre: E n / h(n).

    semi_axes    (3,)  m
    orientation  (4,)     of its axes, in the frame of `normal`
    normal       (3,)     unit normal of the object
    """
    scaled = multiply_components(semi_axes, rotations.rotate(rotations.conjugate(orientation), normal))
    return rotations.rotate(orientation, vec3.scale(1.0 / vec3.norm(scaled), multiply_components(semi_axes, scaled)))


@nearest_on_minkowski_sum.of(Plane)
def nearest_over_plane(shape: Plane, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    support = vec3.dot(shape.normal, support_vector(grown.semi_axes, grown.orientation, shape.normal))
    gap = vec3.dot(shape.normal, x) - shape.offset - support
    return gap, vec3.add_scaled(x, -gap, shape.normal), shape.normal


@nearest_on_minkowski_sum.of(Sphere)
def nearest_over_sphere(shape: Sphere, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Use the symmetry of the ellipsoid about its centre: x and the sphere's centre can be exchanged."""
    local = rotations.rotate(rotations.conjugate(grown.orientation), x)
    gap, point, normal = closest_on_ellipsoid(Ellipsoid(grown.semi_axes, 1.0), local)
    center = rotations.rotate(grown.orientation, vec3.add_scaled(point, shape.radius, normal))
    return gap - shape.radius, center, rotations.rotate(grown.orientation, normal)


@nearest_on_minkowski_sum.of(Cylinder)
def nearest_over_cylinder(shape: Cylinder, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Use the ellipsoid's projection along z.

    Its matrix is the upper left 2 x 2 block of E, a Gram matrix. By the Cauchy-Binet formula, the product of its
    eigenvalues is a sum of squares, so no close numbers are subtracted.
    """
    a, back = grown.semi_axes, rotations.conjugate(grown.orientation)
    u, v = (
        multiply_components(a, rotations.rotate(back, X_AXIS)),
        multiply_components(a, rotations.rotate(back, Y_AXIS)),
    )
    uu, vv, uv = vec3.dot(u, u), vec3.dot(v, v), vec3.dot(u, v)
    half = 0.5 * (uu - vv)
    spread = sqrt(half * half + uv * uv)
    longest = sqrt(0.5 * (uu + vv) + spread)
    area = vec3.norm(multiply_components((a[1] * a[2], a[2] * a[0], a[0] * a[1]), rotations.rotate(back, Z_AXIS)))
    along = (half + spread, uv, 0.0) if half >= 0.0 else (uv, spread - half, 0.0)
    _, turned = compute_direction(along, X_AXIS)
    c, s = turned[0], turned[1]
    # The third semi-axis has no effect: the point is in the plane normal to it.
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
    """Compute W = (1 + W_o S)^-1 W_o in tangents u, v, with W_o of the object, S = E / h - E n (E n)^T / h^3.

    The displacements of the centre per rotation of the normal add up: W_o^-1 on the object, S on the fingertip.
    Source: Schneider, Convex Bodies, section 2.5.
    """
    ku, kv, u = curvature(shape.shape, 0.0, point, normal)
    v = vec3.cross(normal, u)
    back, a = rotations.conjugate(shape.orientation), shape.semi_axes
    n = multiply_components(a, rotations.rotate(back, normal))
    p, q = multiply_components(a, rotations.rotate(back, u)), multiply_components(a, rotations.rotate(back, v))
    h = vec3.norm(n)
    along, across = vec3.dot(n, p) / h, vec3.dot(n, q) / h
    uu, vv = (vec3.dot(p, p) - along * along) / h, (vec3.dot(q, q) - across * across) / h
    uv = (vec3.dot(p, q) - along * across) / h
    size = (1.0 + ku * uu) * (1.0 + kv * vv) - ku * kv * uv * uv
    first, second, mixed = ku * (1.0 + kv * vv) / size, kv * (1.0 + ku * uu) / size, -ku * kv * uv / size
    half, mean = 0.5 * (first - second), 0.5 * (first + second)
    spread = sqrt(half * half + mixed * mixed)
    _, turned = compute_direction((half + spread, mixed, 0.0) if half >= 0.0 else (mixed, spread - half, 0.0), X_AXIS)
    return mean + spread, mean - spread, vec3.add_scaled(vec3.scale(turned[0], u), turned[1], v)
