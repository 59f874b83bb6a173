"""Equilibrium of the proxy on several objects or triangles of a mesh, without friction."""

from typing import Any

from softfinger.proxy.kernels.contact.normal import compute_spring_force
from softfinger.proxy.kernels.contact.rest.active_set import (
    add_constraint,
    add_touched,
    compute_spring_load,
    count_constraints,
    is_enclosed,
    is_support_point_of,
    list_objects,
    make_single_constraint,
    merge_support_points,
    sort_by_load,
    sum_displacements,
)
from softfinger.proxy.kernels.contact.rest.cutting_planes import (
    LIFT_AFTER,
    LIFT_DEPTH,
    MAX_EDGES,
    REST_STEP,
    Rest,
    settle_by_planes,
)
from softfinger.proxy.kernels.contact.rest.one_object import MAX_ROUNDS, MAX_SLIDING_ROUNDS
from softfinger.proxy.kernels.contact.rest.projection import is_safe_step, project_until_rest
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined_where
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import ActiveSet, Constraint, SmoothSearch, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.kinds import (
    are_all_smooth,
    has_creases_at,
    has_creases_near,
    has_slow_query,
)
from softfinger.proxy.kernels.query.objects import (
    NO_GAP,
    find_closest_within,
    find_deepest,
    find_neighbour,
    is_near_mesh,
    remove_creases,
)
from softfinger.proxy.kernels.query.sweep import find_first_hit
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE_TOLERANCE, MAX_STRIDE, SETTLED_STEP

MAX_HITS = 4
"""Largest number of objects that the proxy hits on its path in a tick: three constraints, and the one that stops it."""
MAX_OBSTACLES = 16
"""Largest number of obstacles added to the active set in a tick. If more are found, the proxy does not move in it."""


@outlined_where(has_slow_query)
def settle_among_several(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Rest:
    """Return the rest position of the proxy on several objects, without friction.

    start   (3,) m  start of its path in this tick, for the detection of obstacles: see `find_first_hit`
    center  (3,) m  proxy, after the motion of the objects that support it
    active          constraints that support it, with their depths
    budget          remaining budget

    Over meshes and height maps, the motion in a tick is so short that the proxy cannot cross a thin part
    (`is_safe_step`). If a probe deep inside requires a longer one, the proxy follows in several ticks: the goal is
    moved closer, so that every step ends at rest. The same applies if no rest position is found.

    A proxy on smooth objects that touches no mesh or height map moves as in a scene without them.
    """
    if isinstance(objects.search, SmoothSearch):
        return settle_for(objects, radius, probe, start, center, active, budget)
    reach = 2.0 * (radius + vec3.norm(vec3.sub(probe, center)))  # the path of the proxy
    is_creased = has_creases_near(objects)
    is_rough = is_creased or is_near_mesh(objects, center, reach)
    if not is_rough or are_all_smooth(objects, active):
        part = budget // 4 if is_rough else budget
        rest = settle_for(remove_creases(objects), radius, probe, start, center, active, part)
        budget -= part
        is_allowed = not rest.is_late and is_safe_step(center, rest.center, radius)
        if not is_rough or (is_allowed and are_all_smooth(objects, rest.active)):
            return Rest(rest.center, rest.active, rest.is_late, budget + rest.budget)
    if is_creased:
        return settle_in_steps(objects, radius, probe, start, center, active, budget)
    return settle_on_facets(objects, radius, probe, center, active, budget)


@jit
def settle_in_steps(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, remaining: int
) -> Rest:
    rest, target, constraints = Rest(center, active, True, 0), probe, active
    for budget in (3 * remaining // 4, remaining // 4):
        goal = vec3.add(target, sum_displacements(constraints))
        if is_safe_step(center, goal, radius):
            rest = settle_for(objects, radius, target, start, center, constraints, budget)
            if not is_safe_step(center, rest.center, radius):  # it may have crossed a thin part
                rest = Rest(center, active, True, rest.budget)
        if not rest.is_late:
            break
        depth = vec3.sub(probe, center)
        target = vec3.add_scaled(center, min(0.5 * MAX_STRIDE * radius / vec3.norm(depth), 0.5), depth)
        _, constraints, _, _ = project_until_rest(objects, radius, target, center, active, 1, rest.budget)
    if target == probe:
        return rest
    _, constraints, _, _ = project_until_rest(objects, radius, probe, rest.center, rest.active, 1, rest.budget)
    return Rest(rest.center, constraints, True, rest.budget)


@jit
def settle_on_facets(objects: Any, radius: float, probe: Vec3, anchor: Vec3, active: ActiveSet, budget: int) -> Rest:
    """Settle the proxy in a scene with a mesh.

    The first attempt assumes that the last constraints, or the neighbours of their facets, still support the proxy. If
    they do not, or if it would move away from the probe, it moves from the anchor by supporting planes, which is
    slower. The path needs no sweep for obstacles: with a mesh, no step is longer than `is_safe_step` allows.
    """
    center = vec3.add(probe, sum_displacements(active))
    center, support, step, budget = project_until_rest(objects, radius, probe, center, active, MAX_ROUNDS, budget)
    on_nearest = False
    for crossed in range(MAX_EDGES + 1):
        index, is_single = support[0].object_index, support[1].object_index < 0.0
        neighbour = find_neighbour(objects, index, center) if is_single else index
        on_nearest = neighbour == index
        if on_nearest or crossed == MAX_EDGES:
            break
        support = make_single_constraint(neighbour, support[0].normal, 0.0)
        center, support, step, budget = project_until_rest(objects, radius, probe, center, support, MAX_ROUNDS, budget)
    if support[1].object_index < 0.0 and step > SETTLED_STEP * radius:  # perhaps from an edge onto the face
        center, support, step, budget = project_until_rest(objects, radius, probe, center, support, 1, budget)
    to_proxy, to_anchor = vec3.sub(center, probe), vec3.sub(anchor, probe)
    is_nearer = (
        vec3.dot(to_proxy, to_proxy)
        <= (1.0 + INSIDE_TOLERANCE) * vec3.dot(to_anchor, to_anchor) + (REST_STEP * radius) ** 2
    )
    # Beyond the edge of a facet its plane is tilted. The gap does not show that: it changes by the square of the tilt.
    if step <= REST_STEP * radius and on_nearest and is_nearer and is_safe_step(anchor, center, radius):
        gap, _, budget = find_deepest(objects, center, radius, list_objects(support), budget)
        if gap >= radius * (1.0 - INSIDE_TOLERANCE):
            return Rest(center, sort_by_load(objects, support), False, budget)
    center, support, is_late, budget = settle_by_planes(objects, radius, probe, anchor, active, budget)
    if support[0].object_index < 0.0:
        support = make_single_constraint(active[0].object_index, active[0].normal, 0.0)
    elif are_all_smooth(objects, support) and not is_late:
        # The planes may be from before its last motion; those of facets are replaced by `find_constraints_at_rest`.
        _, support, _, budget = project_until_rest(objects, radius, probe, center, support, 1, budget)
    return Rest(center, sort_by_load(objects, support), is_late, budget)


@jit
def settle_for(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, remaining: int
) -> Rest:
    """Settle the proxy in one step, with the remaining budget `remaining`; see `settle_among_several`."""
    is_creased = has_creases_near(objects)
    rounds = MAX_SLIDING_ROUNDS if is_creased else MAX_ROUNDS
    last_center, last_active = center, active
    center, active, remaining = move_along_path(objects, radius, probe, start, active, remaining)
    if not is_creased:
        # The second of two flush objects is active from the start: else the proxy would fall off at the first's edge.
        near = find_deepest(objects, center, radius * (1.0 + INSIDE_TOLERANCE), list_objects(active), remaining)
        active, remaining = add_touched(objects, radius, center, active, near)
    is_clear, lift, budget = False, 0.0, remaining
    for attempt in range(MAX_OBSTACLES):
        center, active, moved, remaining = project_until_rest(
            objects, radius + lift, probe, center, active, rounds, remaining
        )
        if is_creased and attempt == 0:
            center, active = step_over(objects, radius, probe, center, active)
        gap, index, remaining = find_deepest(objects, center, radius, list_objects(active), remaining)
        if gap >= radius * (1.0 - INSIDE_TOLERANCE):
            is_clear = True
            break
        if remaining < 0:
            break
        if gap > radius * (1.0 - LIFT_DEPTH) and (attempt >= LIFT_AFTER or 4 * remaining < 3 * budget):
            lift = 2.0 * (radius - gap)
        is_new = index != active[0].object_index and index != active[1].object_index and index != active[2].object_index
        if not (is_new or is_creased) and moved <= SETTLED_STEP * radius:
            break  # pinched: a further projection would not move it
        if is_new or is_creased:
            _, _, normal, remaining = find_closest_within(objects, index, center, remaining)
            if is_new or (has_creases_at(objects, index) and not is_support_point_of(active, index, normal)):
                if count_constraints(active) == 3:
                    active, remaining = replace_constraint(
                        objects, radius + lift, probe, center, active, index, normal, remaining
                    )
                else:
                    active = add_constraint(active, index, normal)
    is_late = not is_clear
    if not is_clear:
        # Pinched only if objects have enclosed the proxy; otherwise it does not move, and the next tick continues.
        gap, _, remaining = find_deepest(objects, last_center, radius, list_objects(last_active), remaining)
        is_late = gap >= radius * (1.0 - INSIDE_TOLERANCE) or remaining < 0 or not is_enclosed(active)
        if is_late:
            center = last_center
            _, active, _, remaining = project_until_rest(objects, radius, probe, last_center, last_active, 1, remaining)
    if is_creased:
        active = merge_support_points(active)
    return Rest(center, sort_by_load(objects, active), is_late, remaining)


@jit
def move_along_path(
    objects: Any, radius: float, probe: Vec3, start: Vec3, active: ActiveSet, budget: int
) -> tuple[Vec3, ActiveSet, int]:
    """Move the proxy from `start` (3,) m to the point that `active` allows, and add the objects that it hits.

    Return its center (3,) m, the active set and the remaining budget. If three constraints are active, it stops at the
    fourth object, and continues in the next tick.
    """
    center = vec3.add(probe, sum_displacements(active))
    for _ in range(MAX_HITS):
        hit, stop, budget = find_first_hit(objects, start, center, radius, True, list_objects(active), budget)
        if hit < 0.0:
            break
        _, point, normal, budget = find_closest_within(objects, hit, stop, budget)
        if count_constraints(active) == 3:
            center = stop
            break
        active = add_constraint(active, hit, normal)
        touch = vec3.add_scaled(point, radius, normal)
        center, active, _, budget = project_until_rest(objects, radius, probe, touch, active, 1, budget)
    return center, active, budget


@jit
def replace_constraint(
    objects: Any, radius: float, probe: Vec3, center: Vec3, active: ActiveSet, index: float, normal: Vec3, budget: int
) -> tuple[ActiveSet, int]:
    """Return the active set with a fourth constraint instead of one of three, and the remaining budget.

    It replaces the constraint that the solution of the other three satisfies, or violates least. If it replaced the
    weakest one, which may be needed, the search might never end.
    """
    one, two, three = active
    best, least = active, NO_GAP
    for attempt in range(3):
        dropped = one if attempt == 0 else two if attempt == 1 else three
        trial = two if attempt == 0 else one, two if attempt == 2 else three, Constraint(index, normal, dropped.depth)
        trial_center, trial, _, budget = project_until_rest(objects, radius, probe, center, trial, 1, budget)
        violation = vec3.dot(dropped.normal, vec3.sub(center, trial_center))
        if violation < least:
            best, least = trial, violation
    return best, budget


@jit
def step_over(objects: Any, radius: float, probe: Vec3, goal: Vec3, active: ActiveSet) -> tuple[Vec3, ActiveSet]:
    """Move the goal (3,) m of a proxy on a single facet across its edge, and return goal and active set.

    A test of the neighbours is cheaper than a search of the mesh, which then only confirms the result.
    """
    for _ in range(MAX_EDGES):
        if active[1].object_index >= 0.0:
            break
        neighbour = find_neighbour(objects, active[0].object_index, goal)
        if neighbour == active[0].object_index:
            break
        active = make_single_constraint(neighbour, active[0].normal, 0.0)
        goal, active, _, _ = project_until_rest(objects, radius, probe, goal, active, 1, BUDGET)
    return goal, active


@jit
def compute_trailing_force(objects: Any, active: ActiveSet, to_proxy: Vec3) -> Vec3:
    """Return the additional force (3,) N on a probe with a late proxy at `to_proxy` (3,) m from it.

    The sum of this and the loads of the constraints is the force of a spring between probe and proxy. The constraints
    change while the proxy moves to its rest position, but its distance from the probe does not jump, nor does the
    spring's force.
    """
    distance, pull = vec3.norm(to_proxy), 0.0
    if distance > 0.0:
        pull = compute_spring_force(find_object(objects, active[0].object_index).material.normal, distance) / distance
    loads = map_each(compute_spring_load, (active,), objects)
    supported = vec3.weighted_sum(loads, active[0].normal, active[1].normal, active[2].normal)
    return vec3.sub(vec3.scale(pull, to_proxy), supported)
