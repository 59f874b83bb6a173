"""Rest position of the proxy on one object, with or without a deflection by friction."""

from typing import Any

from softfinger.proxy.kernels.contact.rest.active_set import make_active_set
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import FLAT, ActiveSet, AnyShape, Plane, Pose, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.objects import find_closest_on
from softfinger.proxy.kernels.shapes import is_hollow, rest_on
from softfinger.proxy.kernels.shapes.any_shape import UP
from softfinger.proxy.kernels.shapes.budget import DEEP_SHARE, SETTLED_STEP
from softfinger.proxy.kernels.shapes.kernel_table import REST, SLOTS, KernelSlot, call_kernel

MAX_ROUNDS = 10
"""Largest number of linearisations of a curved surface at the proxy. The digits that each of them gains depend on the
ratio of depth to radius of curvature."""
MAX_SLIDING_ROUNDS = 2
"""The same for a proxy that slides round an object, and on meshes and height maps. The remaining error is far below the
slip of a tick, and the next tick corrects it. A proxy that has not converged is outside, not inside."""
SAME_SIDE_COSINE = 0.5
"""Smallest cosine between the normals of two ticks on the same side of an object: a fingertip does not move round it in
one tick."""


NO_REST = (ZERO, ZERO, 0.0)
SLOTS[REST] = KernelSlot(rest_on, (Pose(ZERO, UP), 0.0, ZERO, ZERO, ZERO, ZERO), NO_REST)


@jit
def settle_on_one(
    objects: Any, index: float, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, float]:
    """Return the rest position of the proxy on object `index`, without regard to other objects.

    center      (3,) m  proxy after its roll
    deflection  (3,) m  tangential, from the probe to the proxy, sustained by friction
    normal      (3,)    of the object at `center`
    returns             proxy (3,) m, its active set, and 1 if the search exhausted its budget, otherwise 0
    """
    body = find_object(objects, index)
    center, normal, budget_exhausted = rest_on(body.shape, body.pose, radius, probe, center, deflection, normal)
    return center, make_active_set(index, normal, vec3.sub(center, probe)), budget_exhausted


@rest_on.of(AnyShape)
def rest_on_any(
    shape: AnyShape, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    if shape.surface >= FLAT:
        return rest_on_plane(shape, pose, radius, probe, center, deflection, normal)
    if shape.kernels[REST] != 0:
        return call_kernel(shape, REST, NO_REST, (pose, radius, probe, center, deflection, normal))
    return rest_on_curved(shape, pose, radius, probe, center, deflection, normal)


@rest_on.of(Plane)
def rest_on_plane(
    shape: Any, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Return the rest position on a plane, which does not depend on the last position of the proxy."""
    gap, _, normal = find_closest_on(shape, pose, probe)
    return vec3.add(probe, vec3.add_scaled(deflection, radius - gap, normal)), normal, 0.0


@jit
def displace_probe(probe: Vec3, deflection: Vec3, center: Vec3, normal: Vec3, radius: float) -> Vec3:
    """Return the probe displaced by the deflection and, if it is deeper than `DEEP_SHARE`, raised to that depth.

    The point nearest to a deeper probe is not stable with friction, see `settle_after_friction`.
    """
    displaced, depth = vec3.add(probe, deflection), vec3.dot(vec3.sub(center, probe), normal)
    if deflection == (0.0, 0.0, 0.0) or depth <= DEEP_SHARE * radius:
        return displaced
    return vec3.add_scaled(displaced, depth - DEEP_SHARE * radius, normal)


@rest_on.otherwise
def rest_on_curved(
    shape: Any, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Return the position nearest to the displaced probe (`displace_probe`; in a hollow it is not raised).

    If it is on another side of the object, the proxy moves round the object: project the displaced probe onto the
    tangent plane, that point onto the surface, and repeat from there. In a hollow the probe itself is displaced by the
    deflection, not its projection onto the tangent plane: the offset surface through the probe is flatter there, and
    the nearest point from it is Newton's step. From the tangent plane, a depth greater than the radius of the surface
    that the centre moves on would diverge.
    """
    hollow, displaced = is_hollow(shape), vec3.add(probe, deflection)
    if not hollow:
        displaced = displace_probe(probe, deflection, center, normal, radius)
    _, point, foot_normal = find_closest_on(shape, pose, displaced)
    if vec3.dot(foot_normal, normal) > SAME_SIDE_COSINE:
        return vec3.add_scaled(point, radius, foot_normal), foot_normal, 0.0
    rounds = MAX_ROUNDS if deflection == (0.0, 0.0, 0.0) else MAX_SLIDING_ROUNDS
    for _ in range(rounds):
        height = -vec3.dot(deflection, normal) if hollow else vec3.dot(vec3.sub(center, displaced), normal)
        _, point, normal = find_closest_on(shape, pose, vec3.add_scaled(displaced, height, normal))
        landing = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(landing, center)
        center = landing
        if vec3.dot(step, step) <= (SETTLED_STEP * radius) ** 2:
            break
    return center, normal, 0.0
