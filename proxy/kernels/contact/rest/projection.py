"""Projection of the probe onto the tangent planes of the active objects, repeated until the proxy is at rest."""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.contact.rest.active_set import count_constraints
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import ActiveSet, Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import solve_half_spaces
from softfinger.proxy.kernels.query.objects import find_constraint, is_inside, is_world_plane
from softfinger.proxy.kernels.shapes.budget import MAX_STRIDE, SETTLED_STEP


@jit
def is_safe_step(start: Vec3, end: Vec3, radius: float) -> bool:
    """Return True if a fingertip outside at both positions cannot cross anything thin between them."""
    step = vec3.sub(end, start)
    return vec3.dot(step, step) <= (MAX_STRIDE * radius) ** 2


@jit
def choose_linearisation_point(inside: bool, center: Vec3, base: Vec3, p: float, n: Vec3, q: float, m: Vec3) -> Vec3:
    """Return the point (3,) m at which the tangent plane of an object is computed.

    This is the proxy or, for a hollow, the probe displaced by p along n and q along m.
    """
    return vec3.add_scaled(vec3.add_scaled(base, p, n), q, m) if inside else center


@jit
def find_half_space(
    objects: Any, index: float, x: Vec3, radius: float, base: Vec3, normal: Vec3, budget: int
) -> tuple[Vec3, float, int]:
    """Return normal and bound (m) of the tangent plane of an object at `x` (3,) m, relative to `base`.

    Also returns the remaining budget.
    """
    point, normal, budget = find_constraint(objects, index, x, radius, normal, budget)
    return normal, vec3.dot(normal, vec3.sub(point, base)) + radius, budget


@outlined
def project_until_rest(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: ActiveSet, rounds: int, budget: int
) -> tuple[Vec3, ActiveSet, float, int]:
    """Return the point nearest to `base` in front of the tangent planes of all active objects, and their active set.

    Each round computes the tangent planes at the last point. For a pinched proxy the point is between the planes, see
    `solve_half_spaces`. In a hollow, the plane is computed at the probe, displaced by the other constraints, as in
    `rest_on_curved`: from the tangent plane, a depth greater than the radius of the surface that the centre moves on
    would diverge.

    Also returns the distance, m, that the proxy moved in the last round, and the remaining budget.
    """
    square, tolerance = 1e300, (SETTLED_STEP * radius) ** 2
    one, two, three = active
    n1, n2, n3 = one.normal, two.normal, three.normal
    push = (one.depth, two.depth, three.depth)
    inside1, inside2, inside3 = (
        is_inside(objects, one.object_index),
        is_inside(objects, two.object_index),
        is_inside(objects, three.object_index),
    )
    hollow = inside1 or inside2 or inside3
    flat = (
        is_world_plane(objects, one.object_index)
        and is_world_plane(objects, two.object_index)
        and is_world_plane(objects, three.object_index)
    )
    p1, p2, p3 = 0.0, 0.0, 0.0
    for round_index in range(rounds):
        x = choose_linearisation_point(inside1, center, base, p2, n2, p3, n3)
        n1, b1, budget = find_half_space(objects, one.object_index, x, radius, base, n1, budget)
        b2, b3 = b1, b1
        if two.object_index < 0.0:
            n2 = n1
        else:
            x = choose_linearisation_point(inside2, center, base, p1, n1, p3, n3)
            n2, b2, budget = find_half_space(objects, two.object_index, x, radius, base, n2, budget)
        if three.object_index < 0.0:
            n3 = n1
        else:
            x = choose_linearisation_point(inside3, center, base, p1, n1, p2, n2)
            n3, b3, budget = find_half_space(objects, three.object_index, x, radius, base, n3, budget)
        if hollow and round_index == 0 and rounds > 1:  # displacements by single constraints are a good start
            p1 = max(b1, 0.0)
            p2 = 0.0 if two.object_index < 0.0 else max(b2, 0.0)
            p3 = 0.0 if three.object_index < 0.0 else max(b3, 0.0)
            continue
        push, weights = solve_half_spaces(count_constraints(active), n1, n2, n3, b1, b2, b3)
        p1, p2, p3 = weights
        last, center = center, vec3.add(base, vec3.weighted_sum(weights, n1, n2, n3))
        step = vec3.sub(center, last)
        square = 0.0 if flat else vec3.dot(step, step)  # the objects are planes: the solution is exact
        if square <= tolerance:
            break
    constraints = (
        Constraint(one.object_index, n1, push[0]),
        Constraint(two.object_index, n2, push[1]),
        Constraint(three.object_index, n3, push[2]),
    )
    return center, constraints, sqrt(square), budget
