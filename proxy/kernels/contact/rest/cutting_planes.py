"""Rest position of the proxy on facets of meshes, by supporting planes.

A facet, enlarged by the fingertip's radius r, is convex and entirely on one side of each of its supporting planes. So
every point on the other side, in front, is at least r away from the facet. The anchor is the last place of the proxy
that is known to be outside. The half-spaces in front of several supporting planes, each of which contains the anchor,
intersect in a convex region that is outside of all these facets. A step moves to the point of that region nearest to
the probe. If the search of the mesh finds another facet there, the plane of that facet is added and the point is
computed again. The step ends outside and crosses nothing; the next step starts there, with new planes.

A plane that has the anchor behind it would pull the proxy through a thin wall, or out of a crease. Such a plane is
never added. (This is sequential convex programming with an inner approximation of the free space.)
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.rest.active_set import is_enclosed, list_objects
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import NONE, ActiveSet, Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import solve_half_spaces
from softfinger.proxy.kernels.query.kinds import is_mesh_at
from softfinger.proxy.kernels.query.objects import find_closest_within, find_constraint, find_deepest, find_neighbour
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE_TOLERANCE, MAX_STRIDE, NO_BUDGET

MAX_ADDED = 24
"""Largest number of obstructing facets added in a step."""
MAX_STEPS = 4
"""Largest number of steps of the proxy in a tick; a search of the mesh verifies each."""
LIFT_AFTER, LIFT_DEPTH = 3, 1e-4
"""Condition for lifting the proxy off its planes: LIFT_AFTER obstructing facets, or a part of the budget, have been
used, and the depth in the next is below LIFT_DEPTH, as a share of the radius. Otherwise each of many facets at about
the same distance would obstruct the proxy, one after the other."""
MAX_HALVINGS = 6
"""Largest number of halvings of a step that ends inside."""
TOUCH_DISTANCE = 1e-3
"""Distance from a facet, as a share of the radius, up to which its plane is used from the start. Any supporting plane
is valid."""
REST_STEP = 1e-6
"""Step, as a share of the radius, below which the proxy is at rest: it rotates a normal by this value in rad."""
MAX_EDGES = 3
"""Largest number of edges that a fingertip crosses in a tick before the mesh is searched."""
PLANE_TOLERANCE = 1e-9
"""Violation of a fourth plane by the solution of three, as a share of the radius, that counts as rounding."""


class CuttingPlane(NamedTuple):
    """Supporting plane of the object `object_index`, -1 for none: n . x >= offset (m) for x outside."""

    object_index: float
    normal: Vec3
    offset: float


NO_CUTTING_PLANE = CuttingPlane(NONE, (0.0, 0.0, 1.0), 0.0)


class CuttingPlanes(NamedTuple):
    """Up to three planes, unused ones last, and their solution.

    center  (3,) m  point nearest to the probe in front of all planes
    push         m  depth of each constraint
    """

    first: CuttingPlane
    second: CuttingPlane
    third: CuttingPlane
    center: Vec3
    push: Vec3


class Rest(NamedTuple):
    """Rest position of the proxy.

    center  (3,) m  the proxy
    active          constraints that support it
    is_late         True before the rest position is reached: the proxy is on its path, or did not move because no
                    better point outside was found
    budget          remaining budget, below 0 if it was exhausted
    """

    center: Vec3
    active: ActiveSet
    is_late: bool
    budget: int


@jit
def find_supporting_plane(objects: Any, index: float, radius: float, anchor: Vec3, x: Vec3) -> CuttingPlane:
    """Return the supporting plane of an object at the point nearest to `x` (3,) m, if the anchor is in front of it.

    Otherwise return the plane at the point nearest to the anchor, which always is in front of that. The object is a
    triangle or has a shape without a search, so no budget is counted.
    """
    _, point, normal, _ = find_closest_within(objects, index, x, BUDGET)
    normal = orient_normal(objects, index, normal, vec3.sub(anchor, point))
    if vec3.dot(normal, vec3.sub(anchor, point)) < radius * (1.0 - INSIDE_TOLERANCE) and x != anchor:
        _, point, normal, _ = find_closest_within(objects, index, anchor, BUDGET)
        normal = orient_normal(objects, index, normal, vec3.sub(anchor, point))
    return CuttingPlane(index, normal, vec3.dot(normal, point) + radius)


@jit
def orient_normal(objects: Any, index: float, normal: Vec3, apart: Vec3) -> Vec3:
    """Return the normal of a facet towards `apart` (3,): the two sides of a facet are independent walls."""
    if vec3.dot(normal, apart) < 0.0 and is_mesh_at(objects, index):
        return vec3.scale(-1.0, normal)
    return normal


@jit
def solve_planes(one: CuttingPlane, two: CuttingPlane, three: CuttingPlane, probe: Vec3, lift: float) -> CuttingPlanes:
    """Return the planes with their solution: the point nearest to the probe that is in front of all by `lift` m."""
    if one.object_index < 0.0:
        return CuttingPlanes(one, two, three, probe, (0.0, 0.0, 0.0))
    count = 1
    n2, n3 = one.normal, one.normal
    b1 = one.offset + lift - vec3.dot(one.normal, probe)
    b2, b3 = b1, b1
    if two.object_index >= 0.0:
        count, n2 = 2, two.normal
        b2 = two.offset + lift - vec3.dot(n2, probe)
    if three.object_index >= 0.0:
        count, n3 = 3, three.normal
        b3 = three.offset + lift - vec3.dot(n3, probe)
    solution = solve_half_spaces(count, one.normal, n2, n3, b1, b2, b3)
    return CuttingPlanes(
        one, two, three, vec3.add(probe, vec3.weighted_sum(solution.weights, one.normal, n2, n3)), solution.push
    )


@jit
def compute_distance_behind(plane: CuttingPlane, x: Vec3) -> float:
    """Return the distance (m) of `x` behind a plane, negative in front."""
    return plane.offset - vec3.dot(plane.normal, x)


@outlined
def add_plane(planes: CuttingPlanes, plane: CuttingPlane, radius: float, probe: Vec3, lift: float) -> CuttingPlanes:
    """Add a plane and solve.

    Of four planes, an old one is dropped: the one that the solution of the other three satisfies, or violates least.
    """
    one, two, three = planes.first, planes.second, planes.third
    if one.object_index < 0.0:
        return solve_planes(plane, two, three, probe, lift)
    if two.object_index < 0.0:
        return solve_planes(one, plane, three, probe, lift)
    if three.object_index < 0.0:
        return solve_planes(one, two, plane, probe, lift)
    best = solve_planes(one, two, plane, probe, lift)
    least = compute_distance_behind(three, best.center)
    for attempt in range(2):
        if least <= PLANE_TOLERANCE * radius:
            break
        kept, dropped = (one, two) if attempt == 0 else (two, one)
        trial = solve_planes(kept, three, plane, probe, lift)
        violation = compute_distance_behind(dropped, trial.center)
        if violation < least:
            best, least = trial, violation
    return best


@jit
def find_facet_under(objects: Any, index: float, x: Vec3) -> float:
    """Return the flat index of the facet nearest to `x` (3,) m that is at most MAX_EDGES edges from facet `index`."""
    for _ in range(MAX_EDGES):
        neighbour = find_neighbour(objects, index, x)
        if neighbour == index:
            break
        index = neighbour
    return index


@outlined
def find_touching_plane(objects: Any, index: float, radius: float, anchor: Vec3) -> CuttingPlane:
    """Return the plane, at the anchor, of an object or its neighbour; NO_CUTTING_PLANE if neither is touched."""
    index = find_facet_under(objects, index, anchor)
    plane = find_supporting_plane(objects, index, radius, anchor, anchor)
    return NO_CUTTING_PLANE if vec3.dot(plane.normal, anchor) - plane.offset > TOUCH_DISTANCE * radius else plane


@jit
def find_planes(objects: Any, radius: float, anchor: Vec3, active: Vec3) -> CuttingPlanes:
    """Return the planes, not solved, of the objects that touch a proxy at the anchor; `active` are flat indices."""
    one = NO_CUTTING_PLANE if active[0] < 0.0 else find_touching_plane(objects, active[0], radius, anchor)
    two = NO_CUTTING_PLANE if active[1] < 0.0 else find_touching_plane(objects, active[1], radius, anchor)
    three = NO_CUTTING_PLANE if active[2] < 0.0 else find_touching_plane(objects, active[2], radius, anchor)
    if three.object_index == one.object_index or three.object_index == two.object_index:
        three = NO_CUTTING_PLANE
    if two.object_index == one.object_index:
        two = NO_CUTTING_PLANE
    if two.object_index < 0.0:
        two, three = three, NO_CUTTING_PLANE
    if one.object_index < 0.0:
        one, two, three = two, three, NO_CUTTING_PLANE
    return CuttingPlanes(one, two, three, anchor, (0.0, 0.0, 0.0))


@jit
def list_plane_objects(planes: CuttingPlanes) -> Vec3:
    """Return the flat indices of the objects of the planes, -1 for none."""
    return planes.first.object_index, planes.second.object_index, planes.third.object_index


@jit
def make_constraints(planes: CuttingPlanes) -> ActiveSet:
    """Return the solved planes as an active set."""
    one, two, three, push = planes.first, planes.second, planes.third, planes.push
    n1 = one.normal
    n2 = two.normal if two.object_index >= 0.0 else n1
    n3 = three.normal if three.object_index >= 0.0 else n2
    return (
        Constraint(one.object_index, n1, push[0]),
        Constraint(two.object_index, n2, push[1]),
        Constraint(three.object_index, n3, push[2]),
    )


@jit
def is_touching(objects: Any, constraint: Constraint, radius: float, center: Vec3) -> bool:
    """Return True if the object of a loaded constraint touches the proxy."""
    if constraint.object_index < 0.0 or constraint.depth <= 0.0:
        return True
    _, point, _, _ = find_closest_within(objects, constraint.object_index, center, BUDGET)
    return vec3.norm(vec3.sub(center, point)) <= radius * (1.0 + 3.0 * LIFT_DEPTH)


@jit
def is_touching_all(objects: Any, active: ActiveSet, radius: float, center: Vec3) -> bool:
    """Return True if the objects of all loaded constraints touch the proxy."""
    return (
        is_touching(objects, active[0], radius, center)
        and is_touching(objects, active[1], radius, center)
        and is_touching(objects, active[2], radius, center)
    )


@jit
def step_towards(
    objects: Any, radius: float, probe: Vec3, anchor: Vec3, planes: CuttingPlanes, nearest: bool, budget: int
) -> Rest:
    """Move from the anchor to the point nearest to the probe that the planes allow, by a step that cannot cross a wall.

    nearest  True to add the plane of an obstructing facet nearest to the obstructed point, which is exact on flat
             surfaces; False for that nearest to the anchor: round a convex edge, only this allows the full path
    """
    planes = solve_planes(planes.first, planes.second, planes.third, probe, 0.0)
    center, is_clear, clipped, lift, budget_at_start = anchor, False, False, 0.0, budget
    reserve = budget // 4  # reserve for the halvings
    budget -= reserve
    for added in range(MAX_ADDED):
        center = planes.center
        path = vec3.sub(center, anchor)
        length = vec3.norm(path)
        clipped = length > MAX_STRIDE * radius
        if clipped:
            center = vec3.add_scaled(anchor, MAX_STRIDE * radius / length, path)
        gap, index, budget = find_deepest(objects, center, radius, list_plane_objects(planes), budget)
        if gap >= radius * (1.0 - INSIDE_TOLERANCE):
            is_clear = True
            break
        if budget < 0 or index < 0.0:
            break
        plane = find_supporting_plane(objects, index, radius, anchor, center if nearest else anchor)
        if gap > radius * (1.0 - LIFT_DEPTH) and (added >= LIFT_AFTER or 2 * budget < budget_at_start):
            lift = 2.0 * (radius - gap)
        one, two, three = planes.first, planes.second, planes.third
        if index == one.object_index:
            one = plane
        elif index == two.object_index:
            two = plane
        elif index == three.object_index:
            three = plane
        else:
            planes = add_plane(planes, plane, radius, probe, lift)
            continue
        planes = solve_planes(one, two, three, probe, lift)
    if lift != 0.0:
        planes = solve_planes(planes.first, planes.second, planes.third, probe, 0.0)
    active, is_late = make_constraints(planes), budget < 0
    budget = max(budget, 0) + reserve
    if is_clear:
        return Rest(center, active, clipped, budget)
    # Too many facets at about the same distance. Every point on the path to the last centre is closer to the probe
    # than the anchor.
    path = vec3.sub(center, anchor)
    for _ in range(MAX_HALVINGS):
        if budget < 0:
            break
        path = vec3.scale(0.5, path)
        gap, _, budget = find_deepest(objects, vec3.add(anchor, path), radius, list_plane_objects(planes), budget)
        if gap >= radius * (1.0 - INSIDE_TOLERANCE):
            return Rest(vec3.add(anchor, path), active, True, NO_BUDGET if is_late else budget)
    # Pinched only if objects have enclosed the proxy; otherwise it does not move, and the next tick continues.
    gap, _, budget = find_deepest(objects, anchor, radius, list_plane_objects(planes), budget)
    if budget < 0 or gap >= radius * (1.0 - INSIDE_TOLERANCE) or not is_enclosed(active):
        return Rest(anchor, active, True, NO_BUDGET if is_late else budget)
    return Rest(center, active, False, budget)


@outlined
def settle_by_planes(objects: Any, radius: float, probe: Vec3, anchor: Vec3, active: ActiveSet, budget: int) -> Rest:
    """Move the proxy from the anchor, where it is outside, to rest. Each step ends outside and closer to the probe."""
    rest, nearest = Rest(anchor, active, True, budget), True
    for _ in range(MAX_STEPS):
        planes = find_planes(objects, radius, rest.center, list_objects(rest.active))
        before = rest.center
        rest = step_towards(objects, radius, probe, before, planes, nearest, rest.budget)
        if rest.budget < 0 or (not rest.is_late and is_touching_all(objects, rest.active, radius, rest.center)):
            break
        if not rest.is_late or vec3.norm(vec3.sub(rest.center, before)) <= REST_STEP * radius:
            if not nearest:
                break
            nearest = False
    return rest


@jit
def find_tangent_plane(constraint: Constraint, objects: Any, radius: float, center: Vec3) -> CuttingPlane:
    """Return the tangent plane of the object of a constraint for a proxy at `center` (3,) m, or NO_CUTTING_PLANE."""
    if constraint.object_index < 0.0:
        return NO_CUTTING_PLANE
    point, normal, _ = find_constraint(objects, constraint.object_index, center, radius, constraint.normal, BUDGET)
    return CuttingPlane(constraint.object_index, normal, vec3.dot(normal, point) + radius)


@outlined
def solve_tangent_planes(
    objects: Any, radius: float, probe: Vec3, center: Vec3, active: ActiveSet
) -> tuple[ActiveSet, Vec3]:
    """Solve for a probe the tangent planes that the active objects have at a proxy at `center` (3,) m.

    Returns the active set with its new depths, and the point (3,) m nearest to the probe in front of these planes.
    """
    one, two, three = map_each(find_tangent_plane, (active,), objects, radius, center)
    planes = solve_planes(one, two, three, probe, 0.0)
    return make_constraints(planes), planes.center
