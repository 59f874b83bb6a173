"""Equilibrium of the proxy on several objects or triangles of a mesh, without friction."""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.contact.normal import spring
from softfinger.proxy.kernels.contact.rest.active_set import (
    active_objects,
    active_set_of_one,
    add_constraint,
    add_touched,
    count_of,
    displacement_of,
    drop_weakest,
    is_support_point_of,
    leaves_no_room,
    loads_of,
    merge_support_points,
    one_constraint,
    sort_by_load,
)
from softfinger.proxy.kernels.contact.rest.cutting_planes import AT_REST, EDGES, NEARLY, SOON, Rest, settle_by_planes
from softfinger.proxy.kernels.contact.rest.one_object import ROUNDS, SAME_SIDE, SLIDING_ROUNDS
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined, outlined_where
from softfinger.proxy.kernels.model import ActiveSet, Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import Depths, displacement, solve_half_spaces
from softfinger.proxy.kernels.query.kinds import (
    SINGLE_POINT,
    WITH_HEIGHTMAP,
    WITH_MESH,
    any_creases,
    any_multipoint,
    by_multipoint,
    has_creases_at,
    is_mesh_at,
    takes_long,
)
from softfinger.proxy.kernels.query.objects import (
    closest_to_within,
    constraint_of,
    deepest,
    is_inside,
    is_world_plane,
    neighbour_on,
    normal_law_of,
)
from softfinger.proxy.kernels.query.sweep import first_hit
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE, SETTLED, STRIDE

ATTEMPTS, ATTEMPTS_ON_MANY = 4, 16
"""Largest number of obstacles added to the active set in a tick, without and with meshes or height maps. If more are
found, the proxy does not move in this tick."""


@outlined_where(takes_long)
def settle_among_several(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Rest:
    """Return the rest position of the proxy among several objects, without friction.

    start   (3,) m  start of its path in this tick, for the detection of obstacles: see `first_hit`
    center  (3,) m  proxy, after the motion of the objects that support it
    active          constraints that support it, with their depths
    budget          remaining budget

    Over meshes and height maps, the motion in a tick is so short that the proxy cannot cross a thin part
    (`is_safe_step`). If a probe deep inside requires a longer one, the proxy follows in several ticks: the goal is
    moved closer, so that every step ends at rest. The same applies if no rest position is found.
    """
    return settle_by_search(objects, radius, probe, start, center, active, budget)


@by_multipoint
def settle_by_search(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Any:
    """Settle the proxy: with height maps in short steps, with meshes by supporting planes, otherwise in one step."""


@settle_by_search.of(WITH_HEIGHTMAP)
def settle_in_steps(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, left: int
) -> Rest:
    rest, target, constraints = Rest(center, active, True, 0), probe, active
    for budget in (3 * left // 4, left // 4):
        goal = vec3.add(target, displacement_of(constraints))
        if is_safe_step(center, goal, radius):
            rest = settle_for(objects, radius, target, start, center, constraints, budget)
            if not is_safe_step(center, rest.center, radius):  # it may have crossed a thin part
                rest = Rest(center, active, True, rest.budget)
        if not rest.late:
            break
        depth = vec3.sub(probe, center)
        target = vec3.add_scaled(center, min(0.5 * STRIDE * radius / vec3.norm(depth), 0.5), depth)
        _, constraints, _ = relax(objects, radius, target, center, active, 1, rest.budget)
    if target == probe:
        return rest
    _, constraints, _ = relax(objects, radius, probe, rest.center, rest.active, 1, rest.budget)
    return Rest(rest.center, constraints, True, rest.budget)


@settle_by_search.of(WITH_MESH)
def settle_on_facets(
    objects: Any, radius: float, probe: Vec3, start: Vec3, anchor: Vec3, active: ActiveSet, budget: int
) -> Rest:
    """Settle the proxy in a scene with a mesh.

    The first attempt assumes that the last constraints, or the neighbours of their facets, still support the proxy. If
    they do not, or if it would move away from the probe, it moves from the anchor by supporting planes, which is
    slower. The path needs no sweep for obstacles: with a mesh, no step is longer than `is_safe_step` allows.
    """
    center = vec3.add(probe, displacement_of(active))
    center, support, moved, budget = project_until_rest(objects, radius, probe, center, active, ROUNDS, budget)
    on_nearest = False
    for turn in range(EDGES + 1):
        index, is_single = support[0].body, support[1].body < 0.0
        neighbour = neighbour_on(objects, index, center) if is_single else index
        on_nearest = neighbour == index
        if on_nearest or turn == EDGES:
            break
        support = one_constraint(neighbour, support[0].normal, 0.0)
        center, support, moved, budget = project_until_rest(objects, radius, probe, center, support, ROUNDS, budget)
    if support[1].body < 0.0 and moved > SETTLED * radius:  # the last round may have moved from an edge onto the face
        center, support, moved, budget = project_until_rest(objects, radius, probe, center, support, 1, budget)
    to_proxy, to_anchor = vec3.sub(center, probe), vec3.sub(anchor, probe)
    is_nearer = (
        vec3.dot(to_proxy, to_proxy) <= (1.0 + INSIDE) * vec3.dot(to_anchor, to_anchor) + (AT_REST * radius) ** 2
    )
    # Beyond the edge of a facet its plane is tilted. The gap does not show that: it changes by the square of the tilt.
    if moved <= AT_REST * radius and on_nearest and is_nearer and is_safe_step(anchor, center, radius):
        gap, _, budget = deepest(objects, center, radius, active_objects(support), budget)
        if gap >= radius * (1.0 - INSIDE):
            return Rest(center, sort_by_load(objects, support), False, budget)
    center, support, late, budget = settle_by_planes(objects, radius, probe, anchor, active, budget)
    if support[0].body < 0.0:
        support = one_constraint(active[0].body, active[0].normal, 0.0)
    return Rest(center, sort_by_load(objects, support), late, budget)


@jit
def facet_under(objects: Any, index: float, x: Vec3) -> float:
    """Return the flat index of the facet nearest to `x` (3,) m, reached from facet `index` over at most EDGES edges."""
    for _ in range(EDGES):
        neighbour = neighbour_on(objects, index, x)
        if neighbour == index:
            break
        index = neighbour
    return index


@jit
def constraint_over_edge(objects: Any, constraint: Constraint, center: Vec3, others: ActiveSet) -> Constraint:
    """Return the constraint of the facet under a proxy at `center` (3,) m, which may have crossed an edge."""
    body = constraint.body
    if body < 0.0 or not is_mesh_at(objects, body):
        return constraint
    neighbour = facet_under(objects, body, center)
    if neighbour == others[0].body or neighbour == others[1].body or neighbour == others[2].body:
        return constraint
    return Constraint(neighbour, constraint.normal, constraint.depth)


@by_multipoint
def constraints_over_edges(objects: Any, active: ActiveSet, center: Vec3) -> Any:
    """Return the constraints of the facets under a proxy at `center` (3,) m, see `constraint_over_edge`."""


@constraints_over_edges.of(SINGLE_POINT, WITH_HEIGHTMAP)
def keep_constraints(objects: Any, active: ActiveSet, center: Vec3) -> ActiveSet:
    return active


@constraints_over_edges.of(WITH_MESH)
def constraints_over_edges_of_facets(objects: Any, active: ActiveSet, center: Vec3) -> ActiveSet:
    one = constraint_over_edge(objects, active[0], center, active)
    two = constraint_over_edge(objects, active[1], center, (one, active[1], active[2]))
    return one, two, constraint_over_edge(objects, active[2], center, (one, two, active[2]))


@jit
def slide_over_facets(
    objects: Any, index: float, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, bool]:
    """Slide the proxy over the facets of a mesh to the equilibrium of `rest_on_curved`.

    Returns the centre, the active constraints, and whether the proxy is at rest: a proxy without deflection may need
    further steps.
    """
    rounds, square = SLIDING_ROUNDS, 0.0
    if deflection == (0.0, 0.0, 0.0):
        rounds, foot = ROUNDS, facet_under(objects, index, probe)
        _, point, foot_normal, _ = closest_to_within(objects, foot, probe, BUDGET)
        if vec3.dot(foot_normal, normal) > SAME_SIDE:
            center = vec3.add_scaled(point, radius, foot_normal)
            return center, active_set_of_one(foot, foot_normal, vec3.sub(center, probe)), True
    for _ in range(rounds):
        depth = vec3.dot(vec3.sub(center, probe), normal)
        goal = vec3.add(probe, vec3.add_scaled(vec3.reject(deflection, normal), depth, normal))
        index = facet_under(objects, index, goal)
        _, point, normal, _ = closest_to_within(objects, index, goal, BUDGET)
        landing = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(landing, center)
        center, square = landing, vec3.dot(step, step)
        if square <= (SETTLED * radius) ** 2:
            break
    at_rest = rounds == SLIDING_ROUNDS or square <= (AT_REST * radius) ** 2
    return center, active_set_of_one(index, normal, vec3.sub(center, probe)), at_rest


@jit
def is_safe_step(start: Vec3, end: Vec3, radius: float) -> bool:
    """Return True if a fingertip outside at both positions cannot cross anything thin between them."""
    step = vec3.sub(end, start)
    return vec3.dot(step, step) <= (STRIDE * radius) ** 2


@settle_by_search.of(SINGLE_POINT)
def settle_for(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, left: int
) -> Rest:
    """Settle the proxy in one step, with the remaining budget `left`; see `settle_among_several`."""
    is_multipoint = any_multipoint(objects)
    rounds = SLIDING_ROUNDS if is_multipoint else ROUNDS
    last_center, last_active = center, active
    goal = vec3.add(probe, displacement_of(active))
    for _ in range(4):
        hit, stop, left = first_hit(objects, start, goal, radius, True, active_objects(active), left)
        if hit < 0.0:
            break
        _, point, normal, left = closest_to_within(objects, hit, stop, left)
        if count_of(active) == 3:
            # Already three constraints: stop at the fourth, and continue in the next tick.
            goal = stop
            break
        active = add_constraint(active, hit, normal)
        goal, active, left = relax(objects, radius, probe, vec3.add_scaled(point, radius, normal), active, 1, left)
    center = goal
    if not is_multipoint:
        # The second of two flush objects is active from the start: else the proxy would fall off at the first's edge.
        near = deepest(objects, goal, radius * (1.0 + INSIDE), active_objects(active), left)
        active, left = add_touched(objects, radius, goal, active, near)
    found, lift, budget = False, 0.0, left
    for attempt in range(ATTEMPTS_ON_MANY if is_multipoint else ATTEMPTS):
        center, active, left = relax(objects, radius + lift, probe, center, active, rounds, left)
        if is_multipoint and attempt == 0:
            center, active = step_over(objects, radius, probe, center, active)
        gap, at, left = deepest(objects, center, radius, active_objects(active), left)
        if gap >= radius * (1.0 - INSIDE):
            found = True
            break
        if left < 0:
            break
        if gap > radius * (1.0 - NEARLY) and (attempt >= SOON or 4 * left < 3 * budget):
            lift = 2.0 * (radius - gap)
        is_new = at != active[0].body and at != active[1].body and at != active[2].body
        if is_new or any_creases(objects):
            _, _, normal, left = closest_to_within(objects, at, center, left)
            if is_new or (has_creases_at(objects, at) and not is_support_point_of(active, at, normal)):
                if count_of(active) == 3:
                    active = drop_weakest(active)
                active = add_constraint(active, at, normal)
    late = not found
    if not found:
        # Pinched only if objects have enclosed the proxy; otherwise it does not move, and the next tick continues.
        gap, _, left = deepest(objects, last_center, radius, active_objects(last_active), left)
        late = gap >= radius * (1.0 - INSIDE) or left < 0 or not leaves_no_room(active)
        if late:
            center = last_center
            _, active, left = relax(objects, radius, probe, last_center, last_active, 1, left)
    if any_creases(objects):
        active = merge_support_points(active)
    return Rest(center, sort_by_load(objects, active), late, left)


@jit
def step_over(objects: Any, radius: float, probe: Vec3, goal: Vec3, active: ActiveSet) -> tuple[Vec3, ActiveSet]:
    """Move the goal (3,) m of a proxy on a single facet across its edge, and return goal and active set.

    A test of the neighbours is cheaper than a search of the mesh, which then only confirms the result.
    """
    for _ in range(EDGES):
        if active[1].body >= 0.0:
            break
        neighbour = neighbour_on(objects, active[0].body, goal)
        if neighbour == active[0].body:
            break
        active = one_constraint(neighbour, active[0].normal, 0.0)
        goal, active, _ = relax(objects, radius, probe, goal, active, 1, BUDGET)
    return goal, active


@jit
def relax(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: ActiveSet, rounds: int, budget: int
) -> tuple[Vec3, ActiveSet, int]:
    """Return the point nearest to `base` in front of the tangent planes of all active objects, active set, and budget.

    Each round computes the tangent planes at the last point. For a pinched proxy the point is between the planes, see
    `solve_half_spaces`. In a hollow, the plane is computed at the probe, displaced by the other constraints, as in
    `rest_on_curved`: from the tangent plane, a depth greater than the radius of the surface that the centre moves on
    would diverge.
    """
    center, active, _, budget = project_until_rest(objects, radius, base, center, active, rounds, budget)
    return center, active, budget


@jit
def linearisation_point(inside: bool, center: Vec3, base: Vec3, p: float, n: Vec3, q: float, m: Vec3) -> Vec3:
    """Return the point (3,) m at which the tangent plane of an object is computed.

    This is the proxy or, for a hollow, the probe displaced by p along n and q along m.
    """
    return vec3.add_scaled(vec3.add_scaled(base, p, n), q, m) if inside else center


@outlined
def project_until_rest(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: ActiveSet, rounds: int, budget: int
) -> tuple[Vec3, ActiveSet, float, int]:
    """Return `relax`, and the distance, m, that the proxy moved in the last round."""
    square = 1e300
    tolerance = (SETTLED * radius) ** 2
    one, two, three = active
    n1, n2, n3 = one.normal, two.normal, three.normal
    push = Depths(one.depth, two.depth, three.depth)
    inside1, inside2, inside3 = (
        is_inside(objects, one.body), is_inside(objects, two.body), is_inside(objects, three.body)
    )  # fmt: skip
    hollow = inside1 or inside2 or inside3
    flat = (
        is_world_plane(objects, one.body) and is_world_plane(objects, two.body) and is_world_plane(objects, three.body)
    )
    p1, p2, p3 = 0.0, 0.0, 0.0
    for turn in range(rounds):
        at = linearisation_point(inside1, center, base, p2, n2, p3, n3)
        point, n1, budget = constraint_of(objects, one.body, at, radius, n1, budget)
        b1 = vec3.dot(n1, vec3.sub(point, base)) + radius
        b2, b3 = b1, b1
        if two.body < 0.0:
            n2 = n1
        else:
            at = linearisation_point(inside2, center, base, p1, n1, p3, n3)
            point, n2, budget = constraint_of(objects, two.body, at, radius, n2, budget)
            b2 = vec3.dot(n2, vec3.sub(point, base)) + radius
        if three.body < 0.0:
            n3 = n1
        else:
            at = linearisation_point(inside3, center, base, p1, n1, p2, n2)
            point, n3, budget = constraint_of(objects, three.body, at, radius, n3, budget)
            b3 = vec3.dot(n3, vec3.sub(point, base)) + radius
        if hollow and turn == 0 and rounds > 1:  # displacements by single constraints are a good start
            p1 = max(b1, 0.0)
            p2 = 0.0 if two.body < 0.0 else max(b2, 0.0)
            p3 = 0.0 if three.body < 0.0 else max(b3, 0.0)
            continue
        solution = solve_half_spaces(count_of(active), n1, n2, n3, b1, b2, b3)
        push = solution.push
        p1, p2, p3 = solution.place
        landing = vec3.add(base, displacement(solution.place, n1, n2, n3))
        step = vec3.sub(landing, center)
        center = landing
        square = 0.0 if flat else vec3.dot(step, step)  # planes do not turn: the solution is exact
        if square <= tolerance:
            break
    constraints = (
        Constraint(one.body, n1, push.first),
        Constraint(two.body, n2, push.second),
        Constraint(three.body, n3, push.third),
    )
    return center, constraints, sqrt(square), budget


@jit
def trailing_force(objects: Any, active: ActiveSet, to_proxy: Vec3) -> Vec3:
    """Return the additional force (3,) N on a probe with a late proxy at `to_proxy` (3,) m from it.

    The sum of this and the loads of the constraints is the force of a spring between probe and proxy. The constraints
    change while the proxy moves to its rest position, but its distance from the probe does not jump, nor does the
    spring's force.
    """
    distance, (one, two, three) = vec3.norm(to_proxy), loads_of(objects, active)
    pull = 0.0
    if distance > 0.0:
        pull = spring(normal_law_of(objects, active[0].body), distance) / distance
    supported = displacement(Depths(one, two, three), active[0].normal, active[1].normal, active[2].normal)
    return vec3.sub(vec3.scale(pull, to_proxy), supported)
