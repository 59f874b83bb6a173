"""The plane."""

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.model import Plane, Vec3
from softfinger.proxy.kernels.surfaces.contract import any_tangent, closest, curvature, transport


@closest.of(Plane)
def closest_on_plane(shape: Plane, x: Vec3) -> tuple[float, Vec3, Vec3]:
    gap = vec3.dot(shape.normal, x) - shape.offset
    return gap, vec3.add_scaled(x, -gap, shape.normal), shape.normal


@curvature.of(Plane)
def curvature_of_plane(shape: Plane, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    return 0.0, 0.0, any_tangent(normal)


@transport.of(Plane)
def transport_on_plane(shape: Plane, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    return v
