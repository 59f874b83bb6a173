"""Active set: the constraints that support the proxy, and their loads."""

from typing import Any

from softfinger.proxy.kernels.contact.normal import compute_spring_force
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import NONE, ActiveSet, Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import FACING_COSINE
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.objects import find_closest_within
from softfinger.proxy.kernels.shapes.budget import INSIDE_TOLERANCE
from softfinger.proxy.kernels.shapes.composite import NearestObject
from softfinger.proxy.kernels.shapes.protocol import compute_direction

SAME_SUPPORT_COSINE = 1.0 - 1e-4
"""Cosine between the normals of two support points on a height map above which they count as one."""
COPLANAR_VOLUME = 1e-4
"""Volume spanned by three unit normals below which they count as coplanar and may enclose the proxy in that plane."""


@jit
def make_single_constraint(body: float, normal: Vec3, depth: float) -> ActiveSet:
    """Return the active set of a single object."""
    return Constraint(body, normal, depth), Constraint(NONE, normal, 0.0), Constraint(NONE, normal, 0.0)


@jit
def count_constraints(active: ActiveSet) -> int:
    if active[1].object_index < 0.0:
        return 1
    return 2 if active[2].object_index < 0.0 else 3


@jit
def list_objects(active: ActiveSet) -> Vec3:
    """Return the flat indices of the objects, -1 for none."""
    return active[0].object_index, active[1].object_index, active[2].object_index


@jit
def sum_displacements(active: ActiveSet) -> Vec3:
    """Return the displacement (3,) m from the probe to the proxy."""
    one, two, three = active
    return vec3.weighted_sum((one.depth, two.depth, three.depth), one.normal, two.normal, three.normal)


@jit
def make_active_set(index: float, normal: Vec3, to_proxy: Vec3) -> ActiveSet:
    """Return the active set of one object with the proxy at `to_proxy` (3,) m from the probe."""
    return make_single_constraint(index, normal, max(vec3.dot(to_proxy, normal), 0.0))


@jit
def add_constraint(active: ActiveSet, index: float, normal: Vec3) -> ActiveSet:
    one, two, three = active
    if two.object_index < 0.0:
        return one, Constraint(index, normal, two.depth), Constraint(NONE, normal, three.depth)
    return one, two, Constraint(index, normal, three.depth)


@jit
def add_touched(
    objects: Any, radius: float, center: Vec3, active: ActiveSet, near: NearestObject
) -> tuple[ActiveSet, int]:
    """Add the nearest object if it touches the proxy and fewer than three are active; return the remaining budget, too.

    near  result of `find_deepest` at `center`
    """
    gap, index, remaining = near
    one, two, three = active
    is_full_or_active = three.object_index >= 0.0 or index == one.object_index or index == two.object_index
    if gap > radius * (1.0 + INSIDE_TOLERANCE) or is_full_or_active:
        return active, remaining
    _, _, normal, remaining = find_closest_within(objects, index, center, remaining)
    return add_constraint(active, index, normal), remaining


@jit
def compute_spring_load(constraint: Constraint, objects: Any) -> float:
    """Return the elastic normal force of a constraint, N; 0 for an unused one."""
    if constraint.object_index < 0.0:
        return 0.0
    return compute_spring_force(find_object(objects, constraint.object_index).material.normal, constraint.depth)


@jit
def sort_by_load(objects: Any, active: ActiveSet) -> ActiveSet:
    """Remove constraints without load, and replace the first only by one with a clearly larger load (1.5 times).

    A plain comparison of two equal walls would change with every rounding error.
    """
    load = map_each(compute_spring_load, (active,), objects)
    one, two, three = active
    if two.object_index >= 0.0 and load[1] > 1.5 * load[0] and load[1] >= load[2]:
        one, two = two, one
    elif three.object_index >= 0.0 and load[2] > 1.5 * load[0]:
        one, three = three, one
    if three.object_index >= 0.0 and not three.depth > 0.0:
        three = Constraint(NONE, two.normal, 0.0)
    if two.object_index >= 0.0 and not two.depth > 0.0:
        two, three = three, Constraint(NONE, three.normal, 0.0)
    return one, two, three


@jit
def is_enclosed(active: ActiveSet) -> bool:
    """Return True if two constraints face each other, or three enclose the proxy from all sides."""
    one, two, three = active
    if two.object_index < 0.0:
        return False
    if vec3.dot(one.normal, two.normal) < FACING_COSINE:
        return True
    if three.object_index < 0.0:
        return False
    edge = vec3.cross(one.normal, two.normal)
    return (
        vec3.dot(one.normal, three.normal) < FACING_COSINE
        or vec3.dot(two.normal, three.normal) < FACING_COSINE
        or abs(vec3.dot(edge, three.normal)) < COPLANAR_VOLUME
    )


@jit
def is_same_support_point(constraint: Constraint, index: float, normal: Vec3) -> bool:
    return index == constraint.object_index and vec3.dot(normal, constraint.normal) > SAME_SUPPORT_COSINE


@jit
def is_support_point_of(active: ActiveSet, index: float, normal: Vec3) -> bool:
    """Return True if the active set already contains the point of height map `index` with this normal."""
    return (
        is_same_support_point(active[0], index, normal)
        or is_same_support_point(active[1], index, normal)
        or is_same_support_point(active[2], index, normal)
    )


@jit
def merge_support_points(active: ActiveSet) -> ActiveSet:
    """Merge the support points on one height map to one constraint.

    The sum of their displacements, depth times normal, gives its direction and depth.
    """
    one, two, three = active
    if three.object_index >= 0.0 and (three.object_index == one.object_index or three.object_index == two.object_index):
        if three.object_index == one.object_index:
            one = merge_constraints(one, three)
        else:
            two = merge_constraints(two, three)
        three = Constraint(NONE, two.normal, 0.0)
    if two.object_index >= 0.0 and two.object_index == one.object_index:
        one, two = merge_constraints(one, two), three
        three = Constraint(NONE, two.normal, 0.0)
    return one, two, three


@jit
def merge_constraints(one: Constraint, two: Constraint) -> Constraint:
    push = vec3.add_scaled(vec3.scale(one.depth, one.normal), two.depth, two.normal)
    depth, normal = compute_direction(push, one.normal)
    return Constraint(one.object_index, normal, depth)
