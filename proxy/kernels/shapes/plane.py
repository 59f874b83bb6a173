"""Plane."""

from softfinger.proxy.kernels.model import Plane, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import NO_HIT, ahead, any_tangent, closest, curvature, transport, travel


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


@travel.of(Plane)
def travel_to_plane(shape: Plane, start: Vec3, end: Vec3, radius: float, in_contact: bool) -> float:
    before = vec3.dot(shape.normal, start) - shape.offset - radius
    after = vec3.dot(shape.normal, end) - shape.offset - radius
    if after >= 0.0 or (in_contact and after >= before):
        return NO_HIT
    return max(before, 0.0) / (max(before, 0.0) - after)


@ahead.of(Plane)
def straight_ahead(shape: Plane, radius: float, center: Vec3, normal: Vec3, motion: Vec3) -> Vec3:
    return vec3.add(center, motion)
