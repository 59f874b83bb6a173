"""Geometry of each shape: the only file to extend for a new surface.

    closest(shape, x)                  -> gap, point, normal   of the surface point nearest to x
    relative_curvature(shape, r, t, n) -> 1/m                  of fingertip (radius r) and surface along t
    transport(shape, v, n_from, n_to)  -> (3,)                 tangent vector v carried to the new normal

`gap` is the signed distance of x, positive outside; `normal` is the outward unit normal.
"""

from typing import Any

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.model import Plane, Vec3


@by_type
def closest(shape: Any, x: Vec3) -> Any: ...


@by_type
def relative_curvature(shape: Any, radius: float, point: Vec3, normal: Vec3, direction: Vec3) -> Any: ...


@by_type
def transport(shape: Any, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Any: ...


@closest.of(Plane)
def closest_on_plane(shape: Plane, x: Vec3) -> tuple[float, Vec3, Vec3]:
    gap = vec3.dot(shape.normal, x) - shape.offset
    return gap, vec3.add_scaled(x, -gap, shape.normal), shape.normal


@relative_curvature.of(Plane)
def relative_curvature_of_plane(shape: Plane, radius: float, point: Vec3, normal: Vec3, direction: Vec3) -> float:
    return 1.0 / radius


@transport.of(Plane)
def transport_on_plane(shape: Plane, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    return v
