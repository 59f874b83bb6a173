"""Queries of one object of a scene by its index (`container`), and of the nearest of all, in the world frame."""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import CREASED, FACETED, CreasedSearch, Many, Single, SmoothSearch, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of, turn_into, turn_out_of
from softfinger.proxy.kernels.query.carry import find_carry, move_point
from softfinger.proxy.kernels.query.container import (
    MAX_ENTRIES,
    extract_facet,
    extract_row,
    find_facet_step,
    find_object,
    find_world_plane,
    is_beyond,
)
from softfinger.proxy.kernels.query.kinds import find_surface_kind_at, has_mesh
from softfinger.proxy.kernels.shapes import (
    closest,
    closest_within,
    concavity,
    constraint_at,
    curvature,
    is_hollow,
)
from softfinger.proxy.kernels.shapes.composite import NearestObject, nearest_of_shape, neighbour_of
from softfinger.proxy.kernels.shapes.plane import closest_on_plane

NO_OBJECTS: Vec3 = (-1.0, -1.0, -1.0)
"""Three indices of no object."""
NO_GAP = 1e300
"""Gap, m, without an object."""
MAX_SWING_RAD = 0.2
"""Largest angle of the contact round a hollow in a tick, rad; beyond it the contact slides. At 1 kHz that is thirty
turns per second, which no hand follows."""


@jit
def find_closest_on(shape: Any, pose: Any, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Return `closest` of a shape with that pose, in the world frame."""
    gap, point, normal = closest(shape, into(pose, x))
    return gap, out_of(pose, point), turn_out_of(pose, normal)


@jit
def find_closest_within(objects: Any, index: float, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """Return `closest_within` of object `index` in the world frame."""
    is_plane, plane = find_world_plane(objects, index)
    if is_plane:
        gap, foot, up = closest_on_plane(plane, x)
        return gap, foot, up, budget
    body = find_object(objects, index)
    gap, foot, up, budget = closest_within(body.shape, into(body.pose, x), budget)
    return gap, out_of(body.pose, foot), turn_out_of(body.pose, up), budget


@jit
def find_constraint(
    objects: Any, index: float, center: Vec3, radius: float, normal: Vec3, budget: int
) -> tuple[Vec3, Vec3, int]:
    """Return `constraint_at` of object `index` in the world frame."""
    is_plane, plane = find_world_plane(objects, index)
    if is_plane:
        _, foot, up = closest_on_plane(plane, center)
        return foot, up, budget
    body = find_object(objects, index)
    pose = body.pose
    foot, up, budget = constraint_at(body.shape, into(pose, center), radius, turn_into(pose, normal), budget)
    return out_of(pose, foot), turn_out_of(pose, up), budget


@jit
def find_scene_index(objects: Any, index: float) -> float:
    """Return the scene file's index of object `index`, -1 for none; several may form one object of the file."""
    return find_object(objects, index).scene_index if index >= 0.0 else -1.0


@jit
def is_inside(objects: Any, index: float) -> bool:
    """Return True if object `index` is touched from inside."""
    return index >= 0.0 and is_hollow(find_object(objects, index).shape)


@jit
def is_world_plane(objects: Any, index: float) -> bool:
    """Return True if object `index` is a plane at rest, or if there is no object (`index` below 0)."""
    is_plane, _ = find_world_plane(objects, index)
    return is_plane or index < 0.0


@jit
def does_slide_round_hollow(body: Any, radius: float, center: Vec3, normal: Vec3, theta: float) -> bool:
    """Return True if a roll by `theta` rad moves the contact too far round a hollow to roll there.

    The contact turns by k r theta, with k the curvature of the offset surface. In a hollow that the fingertip nearly
    fills, that is many times theta.
    """
    point = into(body.pose, vec3.add_scaled(center, -radius, normal))
    return concavity(body.shape, radius, point, turn_into(body.pose, normal)) * radius * theta > MAX_SWING_RAD


@jit
def compute_curvature(
    objects: Any, index: float, radius: float, center: Vec3, normal: Vec3
) -> tuple[float, float, Vec3]:
    """Return `curvature` of object `index` in the world frame."""
    is_plane, _ = find_world_plane(objects, index)
    if is_plane:
        return 0.0, 0.0, normal
    body = find_object(objects, index)
    point = into(body.pose, vec3.add_scaled(center, -radius, normal))
    k1, k2, along = curvature(body.shape, radius, point, turn_into(body.pose, normal))
    return k1, k2, turn_out_of(body.pose, along)


@jit
def find_neighbour(objects: Any, index: float, x: Vec3) -> float:
    """Return the index of the neighbouring facet if it is closer to `x` (3,) m than object `index`, else `index`."""
    if index < 0.0:
        return index
    body = find_object(objects, index)
    return index + find_facet_step(objects) * neighbour_of(body.shape, into(body.pose, x))


@jit
def find_deepest(objects: Any, x: Vec3, within: float, known: Vec3, budget: int) -> NearestObject:
    """Return the object nearest to `x` (3,) m, with its gap.

    within        m  search distance: objects beyond it may be omitted; the gap is 1e300 if none is found
    known   (3,)     indices of up to three objects, -1 for none, preferred to equally near triangles of their mesh
    budget           nodes and triangles of meshes, and tiles of height maps, that may be visited
    """
    if isinstance(objects, Single):
        body = objects.body
        gap, facet, budget = nearest_of_shape(body.shape, into(body.pose, x), within, known, budget)
        return NearestObject(gap, facet if gap < NO_GAP else -1.0, budget)
    return find_deepest_of_many(objects, x, within, known, -1, budget)


@jit
def find_deepest_of_others(objects: Any, x: Vec3, within: float, index: float, budget: int) -> NearestObject:
    """Return `find_deepest` of all objects except `index`; on a mesh, that is only one of its triangles."""
    known = (index, -1.0, -1.0)
    if isinstance(objects, Single) or find_surface_kind_at(objects, index) == FACETED:
        return find_deepest(objects, x, within, known, budget)
    return find_deepest_of_many(objects, x, within, known, extract_row(index), budget)


@jit
def find_deepest_of_many(objects: Many, x: Vec3, within: float, known: Vec3, skip: int, budget: int) -> NearestObject:
    """Return `find_deepest` of many objects without row `skip`, which may be -1."""
    smallest, index = NO_GAP, -1.0
    for row in range(int(objects.size)):
        if row == skip:
            continue
        gap, facet = NO_GAP, 0.0
        is_plane, plane = find_world_plane(objects, float(row))
        if is_plane:
            gap, _, _ = closest_on_plane(plane, x)
        elif not is_beyond(objects, row, x, min(within, smallest)):
            body = find_object(objects, float(row))
            facets = extract_facets(objects.search, row, known)
            gap, facet, budget = nearest_of_shape(body.shape, into(body.pose, x), within, facets, budget)
        if gap < smallest:
            smallest, index = gap, row + MAX_ENTRIES * facet
    return NearestObject(smallest, index, budget)


@jit
def is_near_mesh(objects: Any, x: Vec3, reach: float) -> bool:
    """Return True if a mesh may be within `reach` m of `x` (3,) m; a mesh out of reach must not change the result."""
    if isinstance(objects, Single) or isinstance(objects.search, SmoothSearch):
        return has_mesh(objects)
    for row in range(int(objects.size)):
        if objects.entries[row].shape.surface == FACETED and not is_beyond(objects, row, x, reach):
            return True
    return False


@jit
def choose_search(radius: float, objects: Any, center: Vec3, probe: Vec3) -> Any:
    """Return the objects with the search of a tick: as without height maps if the fingertip cannot reach any.

    center  (3,) m  the proxy after the last tick; relative to a moving object its path starts at the point moved along

    The path of the proxy in the tick is within twice its distance from the probe.
    """
    if isinstance(objects, Many) and isinstance(objects.search, CreasedSearch):
        reach = 2.0 * (radius + vec3.norm(vec3.sub(probe, center)))
        for row in range(int(objects.size)):
            if objects.entries[row].shape.surface == CREASED:
                start = move_point(find_carry(objects, float(row)), center)
                if not (is_beyond(objects, row, probe, reach) and is_beyond(objects, row, start, reach)):
                    return objects
        return remove_creases(objects)
    return objects


@jit
def remove_creases(objects: Any) -> Any:
    """Return the objects with a search as in a scene without height maps, which may still stop a fingertip."""
    if isinstance(objects.search, CreasedSearch):
        return replace(objects, "search", CreasedSearch(objects.search.meshes, 0.0))
    return objects


@jit
def extract_facets(search: Any, row: int, known: Vec3) -> Vec3:
    """Return the triangles of object `row` in up to three object indices, -1 for each index of another object."""
    if isinstance(search, SmoothSearch):
        return known
    return extract_facet_of_row(row, known[0]), extract_facet_of_row(row, known[1]), extract_facet_of_row(row, known[2])


@jit
def extract_facet_of_row(row: int, index: float) -> float:
    return extract_facet(index) if index >= 0.0 and extract_row(index) == row else -1.0
