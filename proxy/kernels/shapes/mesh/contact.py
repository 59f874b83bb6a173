"""Queries of a contact on a mesh: the nearest triangle, and the first hit on a path.

A fingertip's centre that moves less than its distance from the mesh cannot cross it. So the short path of a tick in
contact needs no query: the solve for the rest position finds the triangles at its end.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Facet, Mesh, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, turn_into, turn_out_of
from softfinger.proxy.kernels.shapes.budget import MAX_STRIDE, NO_BUDGET, QUEUE_SIZE
from softfinger.proxy.kernels.shapes.composite import (
    ENOUGH_SHARE,
    NO_LIMIT_M,
    NearestObject,
    nearest_of_shape,
    neighbour_of,
    shade_normal,
)
from softfinger.proxy.kernels.shapes.mesh.nearest import find_nearest
from softfinger.proxy.kernels.shapes.mesh.triangle import (
    closest_on_triangle,
    compute_shaded_normal,
    nearer_neighbour,
    offset_curvature_on_triangle,
)
from softfinger.proxy.kernels.shapes.protocol import (
    NO_HIT,
    X_AXIS,
    closest,
    closest_or_bound,
    curvature,
    meets,
)

NO_TRIANGLE: Vec3 = (-1.0, -1.0, -1.0)
MAX_PATH_QUERIES = 16
"""Limit of the queries on a path: a fingertip that moves along the surface stops after them."""
MAX_TOUCH_QUERIES = 6
"""Limit of the queries on the last part of a path to a first contact."""
NO_SEARCH_LIMIT = 1e300


@jit
def find_nearest_facet(
    mesh: Mesh, x: Vec3, within: float, known: Vec3, budget: int, enough: float
) -> tuple[float, float, int]:
    """Return distance, number of the nearest triangle, and remaining budget.

    The distance (m) of `x` (3,) m is 1e300, and the number -1, if it is not below `within` (m). If the budget was
    exhausted (below 0), now or before, the distance may be a lower bound and the triangle the nearest known.

    The distance is signed only if `within` is unlimited: at the first pose, which may be inside. Later, no centre
    crosses the surface.
    """
    result = find_nearest(mesh, x, within, known, max(budget, 0), enough)
    if result.bound < result.squared_distance:
        return sqrt(result.bound), float(result.triangle), NO_BUDGET
    remaining = NO_BUDGET if budget < 0 else max(budget - result.visits, 0)
    if result.triangle < 0:
        return 1e300, -1.0, remaining
    gap = sqrt(result.squared_distance)
    if within >= NO_SEARCH_LIMIT:
        gap, _, _ = closest_on_triangle(mesh, float(result.triangle), x)
    return gap, float(result.triangle), remaining


@jit
def find_last_outside(mesh: Mesh, start: Vec3, path: Vec3, radius: float, budget: int) -> tuple[float, int]:
    """Return the share of a path that ends inside on which a fingertip remains outside, and the remaining budget.

    Moves by the clearance in each step. The next tick continues from there.
    """
    length, moved = vec3.norm(path), 0.0
    if length == 0.0:  # no motion: the gap is below the radius by rounding only
        return 0.0, budget
    for _ in range(MAX_TOUCH_QUERIES):
        x = vec3.add_scaled(start, moved / length, path)
        gap, triangle, budget = find_nearest_facet(mesh, x, radius + length, NO_TRIANGLE, budget, 0.0)
        if triangle < 0.0 or gap - radius <= 1e-9 * radius:
            break
        moved = min(moved + gap - radius, length)
    return moved / length, budget


@meets.of(Mesh)
def travel_to_facet(
    shape: Mesh, start: Vec3, end: Vec3, radius: float, in_contact: bool, budget: int
) -> tuple[float, float, int]:
    """Return the share of the path at the first hit (see `travel`), the number of the triangle, and the budget left.

    With `in_contact`, a short path is never a hit: the solve for the rest position handles contacts at its end. If the
    budget is exhausted, the fingertip stops there.
    """
    path = vec3.sub(end, start)
    length = vec3.norm(path)
    if length <= MAX_STRIDE * radius:
        if in_contact:
            return NO_HIT, 0.0, budget
        gap, triangle, budget = find_nearest_facet(shape, end, radius, NO_TRIANGLE, budget, 0.0)
        if triangle < 0.0 or gap >= radius:
            return NO_HIT, 0.0, budget
        share, remaining = find_last_outside(shape, start, path, radius, budget)
        return share, triangle, remaining
    moved, outside, triangle = 0.0, 0.0, -1.0
    for _ in range(MAX_PATH_QUERIES):
        moved = min(moved, length)
        gap, triangle, budget = find_nearest_facet(
            shape, vec3.add_scaled(start, moved / length, path), radius + length - moved, NO_TRIANGLE, budget, 0.0
        )
        if triangle < 0.0 or (moved == length and gap >= radius):
            return NO_HIT, 0.0, budget
        if budget < 0:
            break
        if moved > 0.0 and gap < radius:
            before = vec3.add_scaled(start, outside / length, path)
            share, budget = find_last_outside(
                shape, before, vec3.scale((moved - outside) / length, path), radius, budget
            )
            return (outside + share * (moved - outside)) / length, triangle, budget
        outside = moved
        moved += max(gap - (1.0 - MAX_STRIDE) * radius, (1.0 - MAX_STRIDE) * radius)
    return outside / length, triangle, budget


@closest.of(Facet)
def closest_on_facet(shape: Facet, x: Vec3) -> tuple[float, Vec3, Vec3]:
    return closest_on_triangle(shape.mesh, shape.triangle, x)


@curvature.of(Facet)
def curvature_of_facet(shape: Facet, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    return offset_curvature_on_triangle(
        shape.mesh, shape.triangle, radius, vec3.add_scaled(point, radius, normal), normal
    )


@closest_or_bound.of(Mesh)
def closest_or_bound_of_mesh(shape: Mesh, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    """Search the entire mesh, for an effect that attracts to the surface."""
    result = find_nearest(shape, x, NO_SEARCH_LIMIT, NO_TRIANGLE, QUEUE_SIZE, 0.0)
    gap, point, normal = closest_on_triangle(shape, float(max(result.triangle, 0)), x)
    return gap, point, normal, 1.0 if result.bound < result.squared_distance else 0.0


@curvature.of(Mesh)
def curvature_of_mesh(shape: Mesh, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    return 0.0, 0.0, X_AXIS


@nearest_of_shape.of(Mesh)
def compute_gap_of_nearest_facet(shape: Mesh, x: Vec3, within: float, known: Vec3, budget: int) -> NearestObject:
    enough = ENOUGH_SHARE * within if within < NO_LIMIT_M else 0.0
    gap, triangle, remaining = find_nearest_facet(shape, x, within, known, budget, enough)
    return NearestObject(gap, triangle, remaining)


@neighbour_of.of(Facet)
def neighbour_of_facet(shape: Facet, x: Vec3) -> float:
    return nearer_neighbour(shape.mesh, shape.triangle, x) - shape.triangle


@shade_normal.of(Facet)
def shade_facet(shape: Facet, pose: Any, normal: Vec3, position: Vec3) -> Vec3:
    """Interpolate the normals of the vertices at the contact point; only the direction of the force changes.

    Source: Morgenbesser and Srinivasan, Force shading for haptic shape perception, 1996.
    """
    triangles = shape.mesh.row[0]
    if triangles.shade == 0.0:
        return normal
    return turn_out_of(
        pose, compute_shaded_normal(shape.mesh, shape.triangle, into(pose, position), turn_into(pose, normal))
    )
