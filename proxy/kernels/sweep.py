"""Which object a fingertip meets first on its way: nothing thin is jumped over in a tick."""

from typing import Any

from numba import literal_unroll

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.frames import into
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Box, CappedCylinder, Capsule, Cylinder, Ellipsoid, Plane, Sphere, Torus, Vec3
from softfinger.proxy.kernels.surfaces import closest

NO_HIT = 2.0
"""Share of the way that says: nothing was met on it."""
ADVANCES = 32
"""Steps of a sweep; each goes as far as the clearance allows, so most sweeps take one or two."""
TOUCHING = 1e-9
"""Clearance, as a share of the radius, that counts as none."""


@by_type
def travel(shape: Any, start: Vec3, end: Vec3, radius: float) -> Any:
    """Share of the way from start to end (local points) at which a sphere of that radius meets the shape."""


@travel.of(Plane)
def travel_to_plane(shape: Plane, start: Vec3, end: Vec3, radius: float) -> float:
    before = vec3.dot(shape.normal, start) - shape.offset - radius
    after = vec3.dot(shape.normal, end) - shape.offset - radius
    if after >= 0.0 or after >= before:
        return NO_HIT
    return max(before, 0.0) / (max(before, 0.0) - after)


def travel_to_shape(shape: Any, start: Vec3, end: Vec3, radius: float) -> float:
    """Conservative advancement: go as far as the clearance, which nothing can be nearer than; ask again."""
    way = vec3.sub(end, start)
    length = vec3.norm(way)
    gap, _, _ = closest(shape, start)
    clearance = gap - radius
    if clearance >= length:
        return NO_HIT
    touching = TOUCHING * radius
    if clearance <= touching:
        gap, _, _ = closest(shape, end)
        return 0.0 if gap - radius < min(clearance, 0.0) else NO_HIT
    share = 0.0
    for _ in range(ADVANCES):
        share += clearance / length
        if share >= 1.0:
            return NO_HIT
        gap, _, _ = closest(shape, vec3.add_scaled(start, share, way))
        clearance = gap - radius
        if clearance <= touching:
            return share
    # A glancing pass comes ever closer without meeting: it counts only if it ends inside.
    gap, _, _ = closest(shape, end)
    return share if gap < radius else NO_HIT


for _kind in (Sphere, Cylinder, CappedCylinder, Capsule, Box, Ellipsoid, Torus):
    travel.of(_kind)(travel_to_shape)


@jit
def first_hit(objects: Any, start: Vec3, end: Vec3, radius: float, skip: Any) -> tuple[float, float]:
    """Share of the way at which the first object is met, and its place in the tuple; NO_HIT and -1 for none.

    `skip` are the places of up to three objects that are not asked.
    """
    share, index = NO_HIT, -1.0
    at = 0.0
    for body in literal_unroll(objects):
        if at != skip[0] and at != skip[1] and at != skip[2]:
            met = travel(body.shape, into(body.pose, start), into(body.pose, end), radius)
            if met < share:
                share, index = met, at
        at += 1.0
    return share, index
