"""All objects of a scene asked in turn, each where its pose puts it.

Objects are of different types, so they stand in a tuple and are asked one after the other by an
unrolled loop. Many of one type stand together in it as `Rows`; `index` is an object's place: see
`entries`.
"""

from typing import Any

from numba import literal_unroll

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Material, Pose, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of, pose_values, turn_into, turn_out_of
from softfinger.proxy.kernels.query.elements import contains, count, element
from softfinger.proxy.kernels.shapes import (
    bend,
    closest,
    closest_or_bound,
    closest_within,
    constraint_at,
    curvature,
    is_hollow,
)
from softfinger.proxy.kernels.shapes.composite import Deepest, has_creases, nearest_of_shape, neighbour_of, raised_clear

NOBODY: Vec3 = (-1.0, -1.0, -1.0)
"""Places of no objects."""
SWING = 0.2
"""Turn of the contact round a hollow in a tick, rad, past which it slides: no hand follows it thirty times a second."""


@jit
def closest_on(body: Any, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """`closest` of one object in the world."""
    gap, point, normal = closest(body.shape, into(body.pose, x))
    return gap, out_of(body.pose, point), turn_out_of(body.pose, normal)


@jit
def closest_or_bound_on(body: Any, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    """`closest_or_bound` of one object in the world."""
    gap, point, normal, unsearched = closest_or_bound(body.shape, into(body.pose, x))
    return gap, out_of(body.pose, point), turn_out_of(body.pose, normal), unsearched


@jit
def closest_to_within(objects: Any, index: float, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """`closest_within` of the object with that place."""
    gap, point, normal = 0.0, x, (0.0, 0.0, 1.0)
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            gap, foot, up, budget = closest_within(body.shape, into(body.pose, x), budget)
            point, normal = out_of(body.pose, foot), turn_out_of(body.pose, up)
        at += count(entry)
    return gap, point, normal, budget


@jit
def constraint_of(
    objects: Any, index: float, center: Vec3, radius: float, normal: Vec3, budget: int
) -> tuple[Vec3, Vec3, int]:
    """`constraint_at` of the object with that place, in the world."""
    point, up = center, normal
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            pose = body.pose
            foot, n, budget = constraint_at(body.shape, into(pose, center), radius, turn_into(pose, normal), budget)
            point, up = out_of(pose, foot), turn_out_of(pose, n)
        at += count(entry)
    return point, up, budget


@jit
def normal_law_of(objects: Any, index: float) -> Any:
    """Law of the normal force of the object with that place; bare objects have no more of a material (`all_bare`)."""
    found = element(objects[0], 0.0).material.normal
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            found = body.material.normal
        at += count(entry)
    return found


@jit
def material_of(objects: Any, index: float) -> Material:
    """Material of the object with that place, of whole objects: all of a scene have the same parts."""
    found = element(objects[0], 0.0).material
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            found = body.material
        at += count(entry)
    return found


@jit
def number_of(objects: Any, index: float) -> float:
    """Number in the scene file of the object with that place, -1 for none; several may make one object."""
    found = -1.0
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            found = body.number
        at += count(entry)
    return found


@jit
def is_inside(objects: Any, index: float) -> bool:
    """Whether the object with that place is touched from inside."""
    inside = False
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            inside = is_hollow(body.shape)
        at += count(entry)
    return inside


@jit
def slides_round_hollow(body: Any, radius: float, center: Vec3, normal: Vec3, theta: float) -> bool:
    """Whether a roll by `theta` rad takes the contact round a hollow so far that its way cannot be followed.

    The contact turns by k r theta, k the curvature of the surface that the centre moves on: any number of times the
    roll in a hollow that the fingertip nearly fills.
    """
    point = into(body.pose, vec3.add_scaled(center, -radius, normal))
    return bend(body.shape, radius, point, turn_into(body.pose, normal)) * radius * theta > SWING


@jit
def curvature_of(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """`curvature` of the object with that place, in the world; 0 of a height map, which may be touched on both sides of
    a valley at once."""
    k1, k2, first = 0.0, 0.0, normal
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            if has_creases(body.shape) == 0.0:
                point = into(body.pose, vec3.add_scaled(center, -radius, normal))
                k1, k2, along = curvature(body.shape, radius, point, turn_into(body.pose, normal))
                first = turn_out_of(body.pose, along)
        at += count(entry)
    return k1, k2, first


@jit
def pose_of(objects: Any, index: float) -> Pose:
    """Pose of the object with that place."""
    found = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            found = pose_values(body.pose)
        at += count(entry)
    return found


@jit
def neighbour_on(objects: Any, index: float, x: Vec3) -> float:
    """Place of the object that is nearer to `x` (3,) m than the one with that place, whose edge it is beyond."""
    beyond = index
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            beyond = index + neighbour_of(body.shape, into(body.pose, x))
        at += count(entry)
    return beyond


@by_type
def nearest_in(entry: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Any:
    """`deepest` among the objects of an entry that begins with the place `at`, as numbers in it."""


@nearest_in.otherwise
def nearest_of_object(entry: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    return nearest_of_shape(entry.shape, into(entry.pose, x), within, at, known, budget)


@nearest_in.of(Rows)
def smallest_gap_in_rows(entry: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    smallest, number = 1e300, 0.0
    for i in range(len(entry)):
        body = element(entry, i)
        gap, _, budget = nearest_of_shape(body.shape, into(body.pose, x), within, at + i, known, budget)
        if gap < smallest:
            smallest, number = gap, float(i)
    return Deepest(smallest, number, budget)


@jit
def deepest(objects: Any, x: Vec3, within: float, known: Vec3, budget: int) -> Deepest:
    """Smallest gap of `x` (3,) m over all objects.

    within        m  gaps beyond it may be left out; of no object, then, is the gap 1e300
    known   (3,)     places of up to three objects, -1 for none, to which no equally near triangle of their mesh is
                     preferred
    budget           nodes and triangles of meshes, and tiles of height maps, that may be asked
    """
    smallest, index = 1e300, -1.0
    at = 0.0
    for entry in literal_unroll(objects):
        gap, number, budget = nearest_in(entry, x, within, at, known, budget)
        if gap < smallest:
            smallest, index = gap, at + number
        at += count(entry)
    return Deepest(smallest, index, budget)


@jit
def raised_clear_of(objects: Any, index: float, center: Vec3, radius: float) -> Vec3:
    """`raised_clear` of the object with that place, in the world."""
    found = center
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            body = element(entry, index - at)
            found = out_of(body.pose, raised_clear(body.shape, into(body.pose, center), radius))
        at += count(entry)
    return found
