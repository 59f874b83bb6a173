"""Sphere, infinite cylinder, capsule and torus: the points at one distance from a point, line, segment or circle."""

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Capsule, Cylinder, Sphere, Torus, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import (
    MIN_NORMAL_COMPONENT,
    X_AXIS,
    Z_AXIS,
    any_tangent,
    around_z,
    closest,
    compute_direction,
    curvature,
    may_be_hollow,
)


@jit
def offset_curvature(radius: float, side: float, fingertip: float) -> float:
    """Return the curvature, 1/m, at the distance `fingertip` from a surface of `radius`: 1 / (fingertip +- radius)."""
    away = fingertip + side * radius
    if side < 0.0:
        # No offset surface for a fingertip that does not fit inside: a large curvature instead, as in `offset`.
        away = min(away, -1e-9 * radius)
    return 1.0 / away


may_be_hollow(Sphere)


@closest.of(Sphere)
def closest_on_sphere(shape: Sphere, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """At the centre, where all points are nearest, return the one on the z axis."""
    distance, outward = compute_direction(x, Z_AXIS)
    gap = shape.side * (distance - shape.radius)
    return gap, vec3.scale(shape.radius, outward), vec3.scale(shape.side, outward)


@curvature.of(Sphere)
def curvature_of_sphere(shape: Sphere, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    k = offset_curvature(shape.radius, shape.side, radius)
    return k, k, any_tangent(normal)


may_be_hollow(Cylinder)


@closest.of(Cylinder)
def closest_on_cylinder(shape: Cylinder, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """On the axis, where a circle of points is nearest, return the one towards +x."""
    distance, outward = compute_direction((x[0], x[1], 0.0), X_AXIS)
    point = (shape.radius * outward[0], shape.radius * outward[1], x[2])
    return shape.side * (distance - shape.radius), point, vec3.scale(shape.side, outward)


@curvature.of(Cylinder)
def curvature_of_cylinder(shape: Cylinder, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Curved round the axis, straight along it."""
    return offset_curvature(shape.radius, shape.side, radius), 0.0, around_z(normal)


may_be_hollow(Capsule)


@closest.of(Capsule)
def closest_on_capsule(shape: Capsule, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """On the segment between the centres of the ends, return the point towards +x."""
    z = min(max(x[2], -shape.half_length), shape.half_length)
    distance, outward = compute_direction((x[0], x[1], x[2] - z), X_AXIS)
    point = vec3.add_scaled((0.0, 0.0, z), shape.radius, outward)
    return shape.side * (distance - shape.radius), point, vec3.scale(shape.side, outward)


@curvature.of(Capsule)
def curvature_of_capsule(shape: Capsule, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Return the curvature of a cylinder if the normal is perpendicular to the axis, otherwise of a sphere."""
    k = offset_curvature(shape.radius, shape.side, radius)
    if abs(normal[2]) <= MIN_NORMAL_COMPONENT:
        return k, 0.0, around_z(normal)
    return k, k, around_z(normal)


may_be_hollow(Torus)


@closest.of(Torus)
def closest_on_torus(shape: Torus, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """On the axis, return the part of the ring towards +x; on the core circle, the point above (+z)."""
    distance, radial = compute_direction((x[0], x[1], 0.0), X_AXIS)
    # In the half plane through the axis and x, with the coordinates along `radial` and z.
    from_core, outward = compute_direction((distance - shape.major, x[2], 0.0), (0.0, 1.0, 0.0))
    level = shape.major + shape.minor * outward[0]
    point = (level * radial[0], level * radial[1], shape.minor * outward[1])
    normal = (outward[0] * radial[0], outward[0] * radial[1], outward[1])
    return shape.side * (from_core - shape.minor), point, vec3.scale(shape.side, normal)


@curvature.of(Torus)
def curvature_of_torus(shape: Torus, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Curvatures round the tube and round the axis; the offset surface is a torus with a tube thicker by `radius`.

    The tangent is computed from the point: on the circles at the top and bottom, the normal is along z everywhere.
    """
    _, radial = compute_direction((point[0], point[1], 0.0), X_AXIS)
    around = (-radial[1], radial[0], 0.0)
    outward = shape.side * vec3.dot(normal, radial)
    # A large curvature, not an infinite one, if the fingertip does not fit into the tube or through the hole.
    tube = max(shape.minor + shape.side * radius, 1e-9 * shape.minor)
    ring = max(shape.major + tube * outward, 1e-9 * shape.major)
    return shape.side / tube, shape.side * outward / ring, vec3.cross(around, normal)
