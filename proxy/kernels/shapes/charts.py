"""Surface coordinates, for textures.

    chart(shape, fade, x, normal) -> Chart    at the surface point under x

The coordinates of a flat face are two of the shape's frame, in the order x, y, z: x and y on the plane and on the ends
of a cylinder; x and y, x and z, or y and z on the faces of a box. On the side of a cylinder they are the arc length
round its axis, zero towards x, and z. `normal` selects the face.
"""

from math import atan2, sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Box, CappedCylinder, Cylinder, Plane, Vec3
from softfinger.proxy.kernels.shapes.protocol import MIN_NORMAL_COMPONENT

NO_EDGE_M = 1e300
"""Distance to the edge of a surface that has no edge, m."""


class Chart(NamedTuple):
    """Coordinates of the surface point under x, and their gradients with respect to x.

    u, v                m         coordinates
    along_u, along_v    (3,) 1    their gradients
    inside              1         0 at the edge of the face, 1 at the distance `fade` from it and beyond, smooth between
    inward              (3,) 1/m  gradient of `inside`
    """

    u: float
    v: float
    along_u: Vec3
    along_v: Vec3
    inside: float
    inward: Vec3


@by_type
def chart(shape: Any, fade: float, x: Vec3, normal: Vec3) -> Any: ...


@jit
def ease(margin: float, fade: float) -> tuple[float, float]:
    """Return 3 s^2 - 2 s^3, with s = margin / fade clamped to [0, 1], and its derivative, 1/m."""
    s = min(max(margin / fade, 0.0), 1.0)
    return s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) / fade


@jit
def ease_at_edge(margin: float, fade: float, coordinate: float) -> tuple[float, float]:
    """Return `ease` at the distance `margin` from the edge, and its derivative with respect to the coordinate."""
    share, slope = ease(margin, fade)
    return share, -slope if coordinate > 0.0 else slope


@jit
def make_flat_chart(fade: float, x: Vec3, normal: Vec3, half: Vec3) -> Chart:
    """Return the chart of a face normal to an axis, |x_i| <= half_i."""
    a, b, c = abs(normal[0]), abs(normal[1]), abs(normal[2])
    i, di = ease_at_edge(half[0] - abs(x[0]), fade, x[0])
    j, dj = ease_at_edge(half[1] - abs(x[1]), fade, x[1])
    k, dk = ease_at_edge(half[2] - abs(x[2]), fade, x[2])
    if c >= a and c >= b:
        return Chart(x[0], x[1], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), i * j, (di * j, i * dj, 0.0))
    if b >= a:
        return Chart(x[0], x[2], (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), i * k, (di * k, 0.0, i * dk))
    return Chart(x[1], x[2], (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), j * k, (0.0, dj * k, j * dk))


@jit
def make_round_chart(radius: float, x: Vec3, share: float, slope: float) -> Chart:
    """Return the chart of the side of a cylinder; `share` and `slope` are `inside` and its derivative along z."""
    # Lower bound: on the axis the arc length has no finite gradient.
    away = max(sqrt(x[0] * x[0] + x[1] * x[1]), MIN_NORMAL_COMPONENT * radius)
    turned = radius / (away * away)
    around = (-turned * x[1], turned * x[0], 0.0)
    return Chart(radius * atan2(x[1], x[0]), x[2], around, (0.0, 0.0, 1.0), share, (0.0, 0.0, slope))


@chart.of(Plane)
def chart_of_plane(shape: Plane, fade: float, x: Vec3, normal: Vec3) -> Chart:
    return make_flat_chart(fade, x, shape.normal, (NO_EDGE_M, NO_EDGE_M, NO_EDGE_M))


@chart.of(Box)
def chart_of_box(shape: Box, fade: float, x: Vec3, normal: Vec3) -> Chart:
    return make_flat_chart(fade, x, normal, shape.half_extents)


@chart.of(Cylinder)
def chart_of_cylinder(shape: Cylinder, fade: float, x: Vec3, normal: Vec3) -> Chart:
    return make_round_chart(shape.radius, x, 1.0, 0.0)


@chart.of(CappedCylinder)
def chart_of_capped_cylinder(shape: CappedCylinder, fade: float, x: Vec3, normal: Vec3) -> Chart:
    if normal[2] * normal[2] > normal[0] * normal[0] + normal[1] * normal[1]:
        away = max(sqrt(x[0] * x[0] + x[1] * x[1]), MIN_NORMAL_COMPONENT * shape.radius)
        share, slope = ease(shape.radius - away, fade)
        inward = (-slope * x[0] / away, -slope * x[1] / away, 0.0)
        return Chart(x[0], x[1], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), share, inward)
    share, slope = ease_at_edge(shape.half_length - abs(x[2]), fade, x[2])
    return make_round_chart(shape.radius, x, share, slope)
