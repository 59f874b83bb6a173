"""The torus: all points at one distance from a circle."""

from softfinger.proxy.kernels.model import Torus, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import (
    X_AXIS,
    closest,
    curvature,
    direction,
    may_be_hollow,
)

may_be_hollow(Torus)


@closest.of(Torus)
def closest_on_torus(shape: Torus, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """On the axis the part of the ring towards x is taken, on the core circle the point above (z)."""
    distance, radial = direction((x[0], x[1], 0.0), X_AXIS)
    # In the half plane through the axis and x: along `radial`, and along z.
    from_core, outward = direction((distance - shape.major, x[2], 0.0), (0.0, 1.0, 0.0))
    level = shape.major + shape.minor * outward[0]
    point = (level * radial[0], level * radial[1], shape.minor * outward[1])
    normal = (outward[0] * radial[0], outward[0] * radial[1], outward[1])
    return shape.side * (from_core - shape.minor), point, vec3.scale(shape.side, normal)


@curvature.of(Torus)
def curvature_of_torus(shape: Torus, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Round the tube, and round the axis: the offset surface is a torus again, its tube thicker by `radius`.

    The tangent round the tube has to come from the point, as the normal of a torus is along z on a whole circle.
    """
    _, radial = direction((point[0], point[1], 0.0), X_AXIS)
    around = (-radial[1], radial[0], 0.0)
    outward = shape.side * vec3.dot(normal, radial)
    # A fingertip that fits neither in the tube nor through the hole gets a large curvature, not an infinite one.
    tube = max(shape.minor + shape.side * radius, 1e-9 * shape.minor)
    ring = max(shape.major + tube * outward, 1e-9 * shape.major)
    return shape.side / tube, shape.side * outward / ring, vec3.cross(around, normal)
