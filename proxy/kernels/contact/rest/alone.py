"""Where the proxy comes to rest on one object, held aside by friction or not."""

from typing import Any

from softfinger.proxy.kernels.contact.rest.active_set import pressed
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import FLAT, ActiveSet, AnyShape, Plane, Pose, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.query.objects import closest_on
from softfinger.proxy.kernels.shapes import is_hollow, rest_on
from softfinger.proxy.kernels.shapes.any_shape import UP
from softfinger.proxy.kernels.shapes.kernel_table import REST, SLOTS, Slot, called

ROUNDS = 10
"""Linearisations of curved surfaces at the proxy; each gains the digits that depth over radius of curvature allows."""
SLIDING_ROUNDS = 2
"""The same for a proxy that slides, and on meshes and height maps: what is left is far below the slip of one tick, and
the next tick takes it up. Short of the end the proxy is outside, not inside."""
SAME_SIDE = 0.5
"""Cosine between two normals of one side of an object, one tick apart: a fingertip does not turn round it in a tick."""
SETTLED = 1e-13
"""Movement, as a share of the fingertip's radius, below which the proxy is at rest."""


NO_REST = (ZERO, ZERO, 0.0)
SLOTS[REST] = Slot(rest_on, (Pose(ZERO, UP), 0.0, ZERO, ZERO, ZERO, ZERO), NO_REST)


@jit
def settle_on_one(
    objects: Any, index: float, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, float]:
    """Bring the proxy to rest on the object with that index, as if there were no other.

    center      (3,) m  where its roll has brought it
    deflection  (3,) m  what friction keeps between proxy and probe, tangent
    normal      (3,)    of the object there
    returns             the proxy (3,) m, its constraint, and 1 if the search had to stop before its end
    """
    body = object_at(objects, index)
    center, normal, bounded = rest_on(body.shape, body.pose, radius, probe, center, deflection, normal)
    return center, pressed(index, normal, vec3.sub(center, probe)), bounded


@rest_on.of(AnyShape)
def rest_on_any(
    shape: AnyShape, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    if shape.surface == FLAT:
        return rest_on_plane(shape, pose, radius, probe, center, deflection, normal)
    if shape.kernels[REST] != 0:
        return called(shape, REST, NO_REST, (pose, radius, probe, center, deflection, normal))
    return rest_on_curved(shape, pose, radius, probe, center, deflection, normal)


@rest_on.of(Plane)
def rest_on_plane(
    shape: Any, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Found from the probe alone, so that a tick does not wait for the last one's proxy."""
    gap, _, normal = closest_on(shape, pose, probe)
    return vec3.add(probe, vec3.add_scaled(deflection, radius - gap, normal)), normal, 0.0


@rest_on.otherwise
def rest_on_curved(
    shape: Any, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Project the probe onto the tangent plane, put that onto the surface, and again from there.

    In a hollow the probe itself is displaced, not its image in the tangent plane: the surface through the probe is the
    flatter one there, and the foot from it is Newton's step. From the tangent plane a depth of more than the radius
    that the centre moves on would lead away.

    Without a deflection the answer is the surface point nearest to the probe, unless that one is on another
    side of the object: then the normal has jumped, and the proxy goes its way round.
    """
    if deflection == (0.0, 0.0, 0.0):
        _, point, foot_normal = closest_on(shape, pose, probe)
        if vec3.dot(foot_normal, normal) > SAME_SIDE:
            return vec3.add_scaled(point, radius, foot_normal), foot_normal, 0.0
    near, rounds = (SETTLED * radius) ** 2, SLIDING_ROUNDS
    if deflection == (0.0, 0.0, 0.0):
        rounds = ROUNDS
    hollow = is_hollow(shape)
    for _ in range(rounds):
        depth = 0.0 if hollow else vec3.dot(vec3.sub(center, probe), normal)
        goal = vec3.add(probe, vec3.add_scaled(vec3.reject(deflection, normal), depth, normal))
        _, point, normal = closest_on(shape, pose, goal)
        moved = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(moved, center)
        center = moved
        if vec3.dot(step, step) <= near:
            break
    return center, normal, 0.0
