"""Active set: the constraints that support the proxy, and their loads."""

from typing import Any

from softfinger.proxy.kernels.contact.normal import spring
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import NONE, ActiveSet, Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import FACING
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.query.objects import closest_to_within
from softfinger.proxy.kernels.shapes.budget import INSIDE
from softfinger.proxy.kernels.shapes.composite import Deepest
from softfinger.proxy.kernels.shapes.protocol import direction

SAME_FOOT = 1.0 - 1e-4
"""Cosine between the normals of two support points on a height map above which they count as one."""
FLAT = 1e-4
"""Volume spanned by three unit normals below which they count as coplanar and may enclose the proxy in that plane."""


@jit
def one_constraint(body: float, normal: Vec3, depth: float) -> ActiveSet:
    """Return the active set of a single object."""
    return Constraint(body, normal, depth), Constraint(NONE, normal, 0.0), Constraint(NONE, normal, 0.0)


@jit
def count_of(active: ActiveSet) -> int:
    if active[1].body < 0.0:
        return 1
    return 2 if active[2].body < 0.0 else 3


@jit
def active_objects(active: ActiveSet) -> Vec3:
    """Return the flat indices of the objects, -1 for none."""
    return active[0].body, active[1].body, active[2].body


@jit
def displacement_of(active: ActiveSet) -> Vec3:
    """Return the displacement (3,) m from the probe to the proxy."""
    one, two, three = active
    return vec3.weighted_sum((one.depth, two.depth, three.depth), one.normal, two.normal, three.normal)


@jit
def active_set_of_one(index: float, normal: Vec3, to_proxy: Vec3) -> ActiveSet:
    """Return the active set of one object with the proxy at `to_proxy` (3,) m from the probe."""
    return one_constraint(index, normal, max(vec3.dot(to_proxy, normal), 0.0))


@jit
def add_constraint(active: ActiveSet, index: float, normal: Vec3) -> ActiveSet:
    one, two, three = active
    if two.body < 0.0:
        return one, Constraint(index, normal, two.depth), Constraint(NONE, normal, three.depth)
    return one, two, Constraint(index, normal, three.depth)


@jit
def add_touched(objects: Any, radius: float, center: Vec3, active: ActiveSet, near: Deepest) -> tuple[ActiveSet, int]:
    """Add the nearest object if it touches the proxy and fewer than three are active; return the remaining budget, too.

    near  result of `deepest` at `center`
    """
    gap, at, remaining = near
    one, two, three = active
    if gap > radius * (1.0 + INSIDE) or three.body >= 0.0 or at == one.body or at == two.body:
        return active, remaining
    _, _, normal, remaining = closest_to_within(objects, at, center, remaining)
    return add_constraint(active, at, normal), remaining


@jit
def drop_weakest(active: ActiveSet) -> ActiveSet:
    """Remove the constraint of three with the smallest depth.

    Its depth remains in the unused element, as the first estimate for the constraint that replaces it.
    """
    one, two, three = active
    if three.depth <= two.depth and three.depth <= one.depth:
        return one, two, Constraint(NONE, two.normal, three.depth)
    if two.depth <= one.depth:
        return one, three, Constraint(NONE, three.normal, two.depth)
    return two, three, Constraint(NONE, three.normal, one.depth)


@jit
def spring_load(constraint: Constraint, objects: Any) -> float:
    """Return the elastic normal force of a constraint, N; 0 for an unused one."""
    if constraint.body < 0.0:
        return 0.0
    return spring(object_at(objects, constraint.body).material.normal, constraint.depth)


@jit
def sort_by_load(objects: Any, active: ActiveSet) -> ActiveSet:
    """Remove constraints without load, and replace the first only by one with a clearly larger load (1.5 times).

    A plain comparison of two equal walls would change with every rounding error.
    """
    load = map_each(spring_load, (active,), objects)
    one, two, three = active
    if two.body >= 0.0 and load[1] > 1.5 * load[0] and load[1] >= load[2]:
        one, two = two, one
    elif three.body >= 0.0 and load[2] > 1.5 * load[0]:
        one, three = three, one
    if three.body >= 0.0 and not three.depth > 0.0:
        three = Constraint(NONE, two.normal, 0.0)
    if two.body >= 0.0 and not two.depth > 0.0:
        two, three = three, Constraint(NONE, three.normal, 0.0)
    return one, two, three


@jit
def leaves_no_room(active: ActiveSet) -> bool:
    """Return True if two constraints face each other, or three enclose the proxy from all sides."""
    one, two, three = active
    if two.body < 0.0:
        return False
    if vec3.dot(one.normal, two.normal) < FACING:
        return True
    if three.body < 0.0:
        return False
    across = vec3.cross(one.normal, two.normal)
    return (
        vec3.dot(one.normal, three.normal) < FACING
        or vec3.dot(two.normal, three.normal) < FACING
        or abs(vec3.dot(across, three.normal)) < FLAT
    )


@jit
def is_foot(constraint: Constraint, at: float, normal: Vec3) -> bool:
    return at == constraint.body and vec3.dot(normal, constraint.normal) > SAME_FOOT


@jit
def is_support_point_of(active: ActiveSet, at: float, normal: Vec3) -> bool:
    """Return True if the active set already contains the point of height map `at` with this normal."""
    return is_foot(active[0], at, normal) or is_foot(active[1], at, normal) or is_foot(active[2], at, normal)


@jit
def merge_support_points(active: ActiveSet) -> ActiveSet:
    """Merge the support points on one height map to one constraint.

    The sum of their displacements, depth times normal, gives its direction and depth.
    """
    one, two, three = active
    if three.body >= 0.0 and (three.body == one.body or three.body == two.body):
        if three.body == one.body:
            one = merge_constraints(one, three)
        else:
            two = merge_constraints(two, three)
        three = Constraint(NONE, two.normal, 0.0)
    if two.body >= 0.0 and two.body == one.body:
        one, two = merge_constraints(one, two), three
        three = Constraint(NONE, two.normal, 0.0)
    return one, two, three


@jit
def merge_constraints(one: Constraint, two: Constraint) -> Constraint:
    push = vec3.add_scaled(vec3.scale(one.depth, one.normal), two.depth, two.normal)
    depth, normal = direction(push, one.normal)
    return Constraint(one.body, normal, depth)
