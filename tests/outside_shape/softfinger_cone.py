"""Shape in a separate package, in one file: an infinite solid cone.

A shape consists of a named tuple of its sizes, kernels `closest` and `curvature` for it, a table for scene files, and a
function that makes the tuple from the table. Import this module before reading a scene; nothing else is needed.
"""

from __future__ import annotations

from math import cos, sin
from typing import Annotated, Any, ClassVar, NamedTuple

from softfinger.config.limits import Range
from softfinger.config.schema import ObjectBase, add_shape, within
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes import closest, curvature
from softfinger.proxy.kernels.shapes.protocol import X_AXIS, compute_direction, compute_offset_curvature
from softfinger.proxy.scene import Body, shape_bodies

ANGLE_RAD = Range(0.05, 1.5, "a needle and a plane are other shapes")


class Cone(NamedTuple):
    """Solid below the apex at the origin, about the z axis; sine and cosine of the half angle at the apex."""

    sine: float
    cosine: float


@closest.of(Cone)
def closest_on_cone(shape: Cone, x: Any) -> Any:
    """Return the closest point on the flank, or the apex. On the axis the flank toward x is used."""
    distance, radial = compute_direction((x[0], x[1], 0.0), X_AXIS)
    down = distance * shape.sine - x[2] * shape.cosine  # along the closest straight line of the flank
    if down <= 0.0:
        gap, normal = compute_direction(x, (0.0, 0.0, 1.0))
        return gap, (0.0, 0.0, 0.0), normal
    gap = distance * shape.cosine + x[2] * shape.sine
    normal = (shape.cosine * radial[0], shape.cosine * radial[1], shape.sine)
    return gap, vec3.add_scaled(x, -gap, normal), normal


@curvature.of(Cone)
def curvature_of_cone(shape: Cone, radius: float, point: Any, normal: Any) -> Any:
    """Return the curvature about the axis, and zero along the flank; on the apex that of the fingertip."""
    _, radial = compute_direction((normal[0], normal[1], 0.0), X_AXIS)
    around = (-radial[1], radial[0], 0.0)
    down = shape.sine * (point[0] * radial[0] + point[1] * radial[1]) - shape.cosine * point[2]
    if down <= 1e-12:
        return 1.0 / radius, 1.0 / radius, around
    return compute_offset_curvature(shape.cosine / (down * shape.sine), radius), 0.0, around


@add_shape
class ConeTable(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="cone"):
    """A cone about the object's z axis, its apex at the origin."""

    shape: ClassVar[str] = "cone"
    half_angle_rad: Annotated[float, within(ANGLE_RAD, "between axis and flank", 0.5)]


@shape_bodies.register
def _cone(table: ConeTable) -> list[Body]:
    return [Body(Cone(sin(table.half_angle_rad), cos(table.half_angle_rad)))]
