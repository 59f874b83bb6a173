"""Box and capped cylinder: solids with sharp edges, touched from outside.

On an edge the nearest point remains the same while the normal turns through the edge's normal cone. So the surface on
which the fingertip's centre moves is smooth: part of a tube about an edge, of a torus about a rim, of a sphere about a
corner.
"""

from softfinger.proxy.kernels.model import Box, CappedCylinder, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import (
    X_AXIS,
    Y_AXIS,
    Z_AXIS,
    any_tangent,
    around_z,
    closest,
    compute_direction,
    curvature,
)

MIN_TILT_RAD = 1e-7
"""Tilt of the normal, rad, up to which a contact round an edge counts as on the face. It lowers the fingertip by less
than the rounding of coordinates of a metre, so the contact may be past a seam, on the face of a flush box."""


@closest.of(Box)
def closest_on_box(shape: Box, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Inside, return the nearest face; of equally near ones, x before y before z, and the positive one first."""
    h = shape.half_extents
    beyond = (abs(x[0]) - h[0], abs(x[1]) - h[1], abs(x[2]) - h[2])
    gap = max(beyond[0], beyond[1], beyond[2])
    if gap > 0.0:
        point = (min(max(x[0], -h[0]), h[0]), min(max(x[1], -h[1]), h[1]), min(max(x[2], -h[2]), h[2]))
        distance, normal = compute_direction(vec3.sub(x, point), X_AXIS)
        return distance, point, normal
    if gap == beyond[0]:
        sign = 1.0 if x[0] >= 0.0 else -1.0
        return gap, (sign * h[0], x[1], x[2]), (sign, 0.0, 0.0)
    if gap == beyond[1]:
        sign = 1.0 if x[1] >= 0.0 else -1.0
        return gap, (x[0], sign * h[1], x[2]), (0.0, sign, 0.0)
    sign = 1.0 if x[2] >= 0.0 else -1.0
    return gap, (x[0], x[1], sign * h[2]), (0.0, 0.0, sign)


@curvature.of(Box)
def curvature_of_box(shape: Box, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Distinguish face, edge and corner by the normal, which has one, two or three components."""
    flat_x, flat_y, flat_z = (
        abs(normal[0]) <= MIN_TILT_RAD,
        abs(normal[1]) <= MIN_TILT_RAD,
        abs(normal[2]) <= MIN_TILT_RAD,
    )
    count = (1 if flat_x else 0) + (1 if flat_y else 0) + (1 if flat_z else 0)
    if count >= 2:
        return 0.0, 0.0, any_tangent(normal)
    if count == 0:
        return 1.0 / radius, 1.0 / radius, any_tangent(normal)
    along = X_AXIS if flat_x else Y_AXIS if flat_y else Z_AXIS
    return 1.0 / radius, 0.0, vec3.cross(along, normal)


@closest.of(CappedCylinder)
def closest_on_capped_cylinder(shape: CappedCylinder, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Inside, return the closer of side and end, the side if equal; on the axis, the side towards +x."""
    distance, outward = compute_direction((x[0], x[1], 0.0), X_AXIS)
    up = 1.0 if x[2] >= 0.0 else -1.0
    beyond_side, beyond_end = distance - shape.radius, abs(x[2]) - shape.half_length
    if beyond_side > 0.0 and beyond_end > 0.0:
        gap, fan = compute_direction((beyond_side, up * beyond_end, 0.0), X_AXIS)
        point = (shape.radius * outward[0], shape.radius * outward[1], up * shape.half_length)
        return gap, point, (fan[0] * outward[0], fan[0] * outward[1], fan[1])
    if beyond_side >= beyond_end:
        return beyond_side, (shape.radius * outward[0], shape.radius * outward[1], x[2]), outward
    return beyond_end, (x[0], x[1], up * shape.half_length), (0.0, 0.0, up)


@curvature.of(CappedCylinder)
def curvature_of_capped_cylinder(
    shape: CappedCylinder, radius: float, point: Vec3, normal: Vec3
) -> tuple[float, float, Vec3]:
    """End: flat. Side: curved round the axis. Rim: across it as the fingertip, round the axis as a torus."""
    around = around_z(normal)
    level = vec3.norm((normal[0], normal[1], 0.0))
    if level <= MIN_TILT_RAD:
        return 0.0, 0.0, around
    if abs(normal[2]) <= MIN_TILT_RAD:
        return 1.0 / (shape.radius + radius), 0.0, around
    return 1.0 / radius, level / (shape.radius + radius * level), vec3.cross(around, normal)
