"""Geometry of each shape: the only file to extend for a new surface.

    closest(shape, x)                  -> gap, point, normal   of the surface point nearest to x
    relative_curvature(shape, r, t, n) -> 1/m                  of fingertip (radius r) and surface along t
    transport(shape, v, n_from, n_to)  -> (3,)                 tangent vector v carried to the new normal

`gap` is the signed distance of x, positive outside; `normal` is the outward unit normal.
"""

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.model import Plane


@by_type
def closest(shape, x): ...


@by_type
def relative_curvature(shape, radius, point, normal, direction): ...


@by_type
def transport(shape, v, normal_from, normal_to): ...


@closest.of(Plane)
def closest_on_plane(shape, x):
    gap = vec3.dot(shape.normal, x) - shape.offset
    return gap, vec3.add_scaled(x, -gap, shape.normal), shape.normal


@relative_curvature.of(Plane)
def relative_curvature_of_plane(shape, radius, point, normal, direction):
    return 1.0 / radius


@transport.of(Plane)
def transport_on_plane(shape, v, normal_from, normal_to):
    return v
