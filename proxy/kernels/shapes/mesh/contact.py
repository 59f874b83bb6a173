"""What a contact asks of a mesh: the nearest of its triangles, and what is met on a way.

A fingertip's centre that has not gone farther than its distance from the mesh has not crossed it, whatever it touches
now: so the short way of a tick asks nothing, and what is touched at its end is found there.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Facet, Mesh, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, turn_into, turn_out_of
from softfinger.proxy.kernels.shapes.budget import ROOM, SPENT, STRIDE
from softfinger.proxy.kernels.shapes.composite import (
    ENOUGH,
    EVERYWHERE,
    Deepest,
    element_of_shape,
    is_mesh_shape,
    nearest_of_shape,
    neighbour_of,
    shaded,
)
from softfinger.proxy.kernels.shapes.mesh.nearest import nearest
from softfinger.proxy.kernels.shapes.mesh.triangle import beyond_edge, closest_on_triangle, shaded_normal
from softfinger.proxy.kernels.shapes.protocol import (
    NO_HIT,
    X_AXIS,
    any_tangent,
    closest,
    closest_or_bound,
    curvature,
    meets,
)

NO_TRIANGLE: Vec3 = (-1.0, -1.0, -1.0)
STRIDES = 16
"""Looks on one way, at most: past so many a fingertip that went along the surface is stopped there."""
LOOKS = 6
"""On the last stretch of a first touch."""
ANYWHERE = 1e300


@jit
def nearest_facet(
    mesh: Mesh, x: Vec3, within: float, known: Vec3, budget: int, enough: float
) -> tuple[float, float, int]:
    """Distance (m) of `x` (3,) m from the mesh if it is smaller than `within`, else 1e300; the number of the nearest
    triangle, -1 for none, and what is left of the budget. Below 0 that was used up, now or before: then the distance
    may be only a bound, below which nothing is, and the triangle the nearest known.

    It is signed where all distances count: at the first pose, which may be inside. From there on no centre crosses it.
    """
    found = nearest(mesh, x, within, known, max(budget, 0), enough)
    if found.bound < found.square:
        return sqrt(found.bound), float(found.number), SPENT
    left = SPENT if budget < 0 else max(budget - found.spent, 0)
    if found.number < 0:
        return 1e300, -1.0, left
    gap = sqrt(found.square)
    if within >= ANYWHERE:
        gap, _, _ = closest_on_triangle(mesh, float(found.number), x)
    return gap, float(found.number), left


@jit
def last_outside(mesh: Mesh, start: Vec3, way: Vec3, radius: float, budget: int) -> tuple[float, int]:
    """Share of a way, which ends inside, that a fingertip can go and be outside still: as far as the clearance each
    time; and what is left of the budget. The next tick goes the rest."""
    length, gone = vec3.norm(way), 0.0
    for _ in range(LOOKS):
        x = vec3.add_scaled(start, gone / length, way)
        gap, number, budget = nearest_facet(mesh, x, radius + length, NO_TRIANGLE, budget, 0.0)
        if number < 0.0 or gap - radius <= 1e-9 * radius:
            break
        gone = min(gone + gap - radius, length)
    return gone / length, budget


@jit
def travel_to_facet(
    shape: Mesh, start: Vec3, end: Vec3, radius: float, leaves: bool, budget: int
) -> tuple[float, float, int]:
    """Share of the way at which something is met, the number of the triangle, and what is left of the budget; see
    `travel`.

    A fingertip that `leaves` rests on triangles, and is held by what it touches at the end of a short way. Where the
    budget is used up it goes no farther.
    """
    way = vec3.sub(end, start)
    length = vec3.norm(way)
    if length <= STRIDE * radius:
        if leaves:
            return NO_HIT, 0.0, budget
        gap, number, budget = nearest_facet(shape, end, radius, NO_TRIANGLE, budget, 0.0)
        if number < 0.0 or gap >= radius:
            return NO_HIT, 0.0, budget
        share, left = last_outside(shape, start, way, radius, budget)
        return share, number, left
    gone, outside, number = 0.0, 0.0, -1.0
    for _ in range(STRIDES):
        gone = min(gone, length)
        gap, number, budget = nearest_facet(
            shape, vec3.add_scaled(start, gone / length, way), radius + length - gone, NO_TRIANGLE, budget, 0.0
        )
        if number < 0.0 or (gone == length and gap >= radius):
            return NO_HIT, 0.0, budget
        if budget < 0:
            break
        if gone > 0.0 and gap < radius:
            before = vec3.add_scaled(start, outside / length, way)
            share, budget = last_outside(shape, before, vec3.scale((gone - outside) / length, way), radius, budget)
            return (outside + share * (gone - outside)) / length, number, budget
        outside = gone
        gone += max(gap - (1.0 - STRIDE) * radius, (1.0 - STRIDE) * radius)
    return outside / length, number, budget


@closest.of(Facet)
def closest_on_facet(shape: Facet, x: Vec3) -> tuple[float, Vec3, Vec3]:
    return closest_on_triangle(shape.mesh, shape.number, x)


@curvature.of(Facet)
def curvature_of_facet(shape: Facet, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Flat: over an edge the fingertip rolls in one tangent plane after the other."""
    return 0.0, 0.0, any_tangent(normal)


@closest_or_bound.of(Mesh)
def closest_known_on_mesh(shape: Mesh, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    """Of the whole mesh: for an effect that draws to the surface."""
    found = nearest(shape, x, ANYWHERE, NO_TRIANGLE, ROOM, 0.0)
    gap, point, normal = closest_on_triangle(shape, float(max(found.number, 0)), x)
    return gap, point, normal, 1.0 if found.bound < found.square else 0.0


@curvature.of(Mesh)
def curvature_of_mesh(shape: Mesh, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    return 0.0, 0.0, X_AXIS


@meets.of(Mesh)
def meets_facet(
    shape: Mesh, start: Vec3, end: Vec3, radius: float, leaves: bool, budget: int
) -> tuple[float, float, int]:
    return travel_to_facet(shape, start, end, radius, leaves, budget)


@is_mesh_shape.of(Facet)
def is_a_facet(shape: Facet) -> float:
    return 1.0


@nearest_of_shape.of(Mesh)
def gap_of_nearest_facet(shape: Mesh, x: Vec3, within: float, known: Vec3, budget: int) -> Deepest:
    enough = ENOUGH * within if within < EVERYWHERE else 0.0
    gap, number, left = nearest_facet(shape, x, within, known, budget, enough)
    return Deepest(gap, number, left)


@neighbour_of.of(Facet)
def neighbour_of_facet(shape: Facet, x: Vec3) -> float:
    return beyond_edge(shape.mesh, shape.number, x) - shape.number


@element_of_shape.of(Mesh)
def facet_of_mesh(shape: Mesh, facet: float) -> Facet:
    return Facet(shape, facet)


@shaded.of(Facet)
def shaded_facet(shape: Facet, pose: Any, normal: Vec3, position: Vec3) -> Vec3:
    """Between the vertices' normals, as the contact point lies between the vertices: Morgenbesser and Srinivasan,
    Force shading for haptic shape perception, 1996. Only the direction of the force changes, not where the proxy is."""
    triangles = shape.mesh.row[0]
    if triangles.shade == 0.0:
        return normal
    return turn_out_of(pose, shaded_normal(shape.mesh, shape.number, into(pose, position), turn_into(pose, normal)))
