"""Torus: all points at one distance from a circle."""

from softfinger.proxy.kernels.model import Torus, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import X_AXIS, closest, curvature, direction, may_be_hollow

may_be_hollow(Torus)


@closest.of(Torus)
def closest_on_torus(shape: Torus, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """On the axis, return the part of the ring towards +x; on the core circle, the point above (+z)."""
    distance, radial = direction((x[0], x[1], 0.0), X_AXIS)
    # In the half plane through the axis and x, with the coordinates along `radial` and z.
    from_core, outward = direction((distance - shape.major, x[2], 0.0), (0.0, 1.0, 0.0))
    level = shape.major + shape.minor * outward[0]
    point = (level * radial[0], level * radial[1], shape.minor * outward[1])
    normal = (outward[0] * radial[0], outward[0] * radial[1], outward[1])
    return shape.side * (from_core - shape.minor), point, vec3.scale(shape.side, normal)


@curvature.of(Torus)
def curvature_of_torus(shape: Torus, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Curvatures round the tube and round the axis; the offset surface is a torus with a tube thicker by `radius`.

    The tangent is computed from the point: on the circles at the top and bottom, the normal is along z everywhere.
    """
    _, radial = direction((point[0], point[1], 0.0), X_AXIS)
    around = (-radial[1], radial[0], 0.0)
    outward = shape.side * vec3.dot(normal, radial)
    # A large curvature, not an infinite one, if the fingertip does not fit into the tube or through the hole.
    tube = max(shape.minor + shape.side * radius, 1e-9 * shape.minor)
    ring = max(shape.major + tube * outward, 1e-9 * shape.major)
    return shape.side / tube, shape.side * outward / ring, vec3.cross(around, normal)
