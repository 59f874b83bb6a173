"""Motion of the proxy over the facets of a mesh, from each to its neighbours, without a search of the mesh."""

from typing import Any

from softfinger.proxy.kernels.contact.rest.active_set import make_active_set
from softfinger.proxy.kernels.contact.rest.cutting_planes import REST_STEP, Rest, find_facet_under, solve_tangent_planes
from softfinger.proxy.kernels.contact.rest.one_object import (
    MAX_ROUNDS,
    MAX_SLIDING_ROUNDS,
    SAME_SIDE_COSINE,
    displace_probe,
)
from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll
from softfinger.proxy.kernels.contact.rolling.on_objects import roll_flat_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import ActiveSet, Constraint, Quaternion, SmoothSearch, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.kinds import are_all_smooth, has_creases_near, is_mesh_at
from softfinger.proxy.kernels.query.objects import find_closest_within
from softfinger.proxy.kernels.shapes.budget import BUDGET, DEEP_SHARE, SETTLED_STEP
from softfinger.proxy.kernels.shapes.protocol import compute_direction, turn_along


@jit
def move_constraint_over_edge(objects: Any, constraint: Constraint, center: Vec3, others: ActiveSet) -> Constraint:
    """Return the constraint of the facet under a proxy at `center` (3,) m, which may have crossed an edge."""
    body = constraint.object_index
    if body < 0.0 or not is_mesh_at(objects, body):
        return constraint
    neighbour = find_facet_under(objects, body, center)
    if (
        neighbour == others[0].object_index
        or neighbour == others[1].object_index
        or neighbour == others[2].object_index
    ):
        return constraint
    return Constraint(neighbour, constraint.normal, constraint.depth)


@jit
def find_constraints_at_rest(objects: Any, radius: float, probe: Vec3, rest: Rest) -> ActiveSet:
    """Return the constraints of a proxy at rest; on meshes, of the facets under it (`move_constraint_over_edge`).

    After a search, the planes may be from before the last motion of the proxy. On meshes they are replaced, unless the
    probe is deeper than `DEEP_SHARE`: there, the force would change by more than the proxy moves. With a height map
    they are not: on a rough one, a proxy that is stuck would seem to be at rest, and not be released.
    """
    active, center = rest.active, rest.center
    if isinstance(objects.search, SmoothSearch) or has_creases_near(objects) or are_all_smooth(objects, active):
        return active
    one = move_constraint_over_edge(objects, active[0], center, active)
    two = move_constraint_over_edge(objects, active[1], center, (one, active[1], active[2]))
    active = one, two, move_constraint_over_edge(objects, active[2], center, (one, two, active[2]))
    depth = vec3.sub(center, probe)
    if not rest.is_late and vec3.dot(depth, depth) <= (DEEP_SHARE * radius) ** 2:
        active, _ = solve_tangent_planes(objects, radius, probe, center, active)
    return active


@jit
def roll_over_edge(
    objects: Any, method: Any, index: float, radius: float, start: OffsetPoint, rolled: Roll, turn: Quaternion
) -> tuple[Roll, float]:
    """Return a roll from `start` on object `index`, continued on the facet beyond its edge, and that facet's index.

    turn  (4,)  rotation of the fingertip relative to the object since the last tick

    A proxy that has rolled round an edge beyond the plane of the next facet is moved to its place on that facet. It
    rolls in the plane of the mean normal of the path, which has the normals of the first facet, of the edge and of the
    second facet, each for its share of the tick. The error is of third order in the angle of a tick, and zero between
    facets of one plane.
    """
    if isinstance(objects.search, SmoothSearch):
        return rolled, index
    facet = find_facet_under(objects, index, rolled.center) if is_mesh_at(objects, index) else index
    if facet == index:
        return rolled, index
    _, _, normal, _ = find_closest_within(objects, facet, rolled.center, BUDGET)
    rate = vec3.cross(rotations.log(turn), normal)
    on_both = compute_share_of_tick(vec3.sub(rolled.normal, start.normal), rate)
    on_next = min(compute_share_of_tick(vec3.sub(rolled.normal, normal), rate), on_both)
    share = 0.5 * (on_both + on_next)
    _, mean = compute_direction(vec3.add_scaled(vec3.scale(1.0 - share, start.normal), share, normal), normal)
    flat = roll_flat_on(method, objects, facet, radius, mean, turn)
    _, point, normal, _ = find_closest_within(objects, facet, vec3.add(start.center, flat.motion), BUDGET)
    center, motion = vec3.add_scaled(point, radius, normal), turn_along(flat.motion, mean, normal)
    return Roll(center, normal, motion, flat.theta, flat.spin, True), facet


@jit
def compute_share_of_tick(bend: Vec3, rate: Vec3) -> float:
    """Return the share of the tick in which the normal rotates by `bend` (3,), at most 1.

    rate  (3,)  change of the normal in a tick round a corner; round an edge, its component along `bend` counts
    """
    along = vec3.dot(bend, rate)
    return min(vec3.dot(bend, bend) / along, 1.0) if along > 0.0 else 0.0


@jit
def slide_over_facets(
    objects: Any, index: float, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, bool]:
    """Move the proxy over the facets of a mesh, with the method of `rest_on_curved`.

    Return its centre (3,) m, the facets that it touches, and True if it is at rest. Without a deflection, further steps
    may be necessary.
    """
    displaced = displace_probe(probe, deflection, center, normal, radius)
    foot = find_facet_under(objects, index, displaced)
    _, point, foot_normal, _ = find_closest_within(objects, foot, displaced, BUDGET)
    if vec3.dot(foot_normal, normal) > SAME_SIDE_COSINE:
        center = vec3.add_scaled(point, radius, foot_normal)
        return center, make_active_set(foot, foot_normal, vec3.sub(center, probe)), True
    rounds, square = MAX_ROUNDS if deflection == (0.0, 0.0, 0.0) else MAX_SLIDING_ROUNDS, 0.0
    for _ in range(rounds):
        goal = vec3.add_scaled(displaced, vec3.dot(vec3.sub(center, displaced), normal), normal)
        index = find_facet_under(objects, index, goal)
        _, point, normal, _ = find_closest_within(objects, index, goal, BUDGET)
        landing = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(landing, center)
        center, square = landing, vec3.dot(step, step)
        if square <= (SETTLED_STEP * radius) ** 2:
            break
    at_rest = rounds == MAX_SLIDING_ROUNDS or square <= (REST_STEP * radius) ** 2
    return center, make_active_set(index, normal, vec3.sub(center, probe)), at_rest
