"""Where the proxy comes to rest among several objects, the triangles of a mesh among them, without friction."""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.normal import spring
from softfinger.proxy.kernels.contact.rest.active_set import (
    INSIDE,
    active_objects,
    count_of,
    displaced_by,
    is_support_point_of,
    leaves_no_room,
    loads_of,
    merge_support_points,
    one_constraint,
    pressed,
    strongest_first,
    with_another,
    with_touched,
    without_weakest,
)
from softfinger.proxy.kernels.contact.rest.alone import ROUNDS, SAME_SIDE, SETTLED, SLIDING_ROUNDS
from softfinger.proxy.kernels.contact.rest.cutting_planes import AT_REST, EDGES, NEARLY, SOON, settle_by_planes
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined_where
from softfinger.proxy.kernels.model import ActiveSet, Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import Depths, displacement, solve_half_spaces
from softfinger.proxy.kernels.query.kinds import (
    SINGLE_POINT,
    WITH_HEIGHTMAP,
    WITH_MESH,
    any_creases,
    any_mesh,
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
    neighbour_on,
    normal_law_of,
)
from softfinger.proxy.kernels.query.sweep import first_hit
from softfinger.proxy.kernels.shapes.budget import BUDGET, STRIDE

ATTEMPTS, ATTEMPTS_ON_MANY = 4, 16
"""Times that something found in the way is added to what holds the proxy, before it stays where it was for a tick."""


class Rest(NamedTuple):
    """Where the proxy (3,) m comes to rest and what holds it there; if it is `late`, a place on the way, or where it
    was since nothing better was found to be outside. And what is left of the budget, below 0 where it was used up."""

    center: Vec3
    active: ActiveSet
    late: bool
    budget: int


@outlined_where(takes_long)
def settle_among_several(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Rest:
    """Bring the proxy to rest among several objects, where it would be without friction.

    start   (3,) m  where its way in this tick begins, for what may be met on it: see `first_hit`
    center  (3,) m  where what holds it has carried it
    active          what holds it, pushing
    left            of the budget

    Over meshes and height maps it goes no farther in a tick than crosses nothing that is thin. A probe that asks
    for more, from deep inside, is followed a step at a time: the goal is shrunk, so that every step ends at rest.
    So is one that finds no rest.
    """
    return settle_by_search(objects, radius, probe, start, center, active, budget)


@by_multipoint
def settle_by_search(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Any:
    """`settle_among_several`: beside height maps step by step, beside meshes by supporting planes, else at once."""


@settle_by_search.of(SINGLE_POINT)
def settle_at_once(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Rest:
    return settle_for(objects, radius, probe, start, center, active, budget)


@settle_by_search.of(WITH_MESH)
def settle_beside_meshes(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, budget: int
) -> Rest:
    return settle_on_facets(objects, radius, probe, center, active, budget)


@settle_by_search.of(WITH_HEIGHTMAP)
def settle_in_steps(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, left: int
) -> Rest:
    rest, whole, held = Rest(center, active, True, 0), probe, active
    for budget in (3 * left // 4, left // 4):
        goal = vec3.add(whole, displaced_by(held))
        if is_a_step(center, goal, radius):
            rest = settle_for(objects, radius, whole, start, center, held, budget)
            if not is_a_step(center, rest.center, radius):  # it may be on the other side of something
                rest = Rest(center, active, True, rest.budget)
        if not rest.late:
            break
        deep = vec3.sub(probe, center)
        whole = vec3.add_scaled(center, min(0.5 * STRIDE * radius / vec3.norm(deep), 0.5), deep)
        _, held, _ = relaxed(objects, radius, whole, center, active, 1, rest.budget)
    if whole == probe:
        return rest
    _, held, _ = relaxed(objects, radius, probe, rest.center, rest.active, 1, rest.budget)
    return Rest(rest.center, held, True, rest.budget)


@jit
def settle_on_facets(objects: Any, radius: float, probe: Vec3, anchor: Vec3, active: ActiveSet, budget: int) -> Rest:
    """`settle_among_several` where there is a mesh: what held the proxy holds it still, or the facet beside that; where
    that is not so, or would take it away from the probe, it goes from the anchor the careful way.

    What crosses the way in a tick needs no sweep: beside a mesh no step is longer than `is_a_step` allows.
    """
    there = vec3.add(probe, displaced_by(active))
    center, held, moved, budget = relaxed_to_rest(objects, radius, probe, there, active, ROUNDS, budget)
    on_nearest = False
    for turn in range(EDGES + 1):
        index, alone = held[0].body, held[1].body < 0.0
        beyond = neighbour_on(objects, index, center) if alone else index
        on_nearest = beyond == index
        if on_nearest or turn == EDGES:
            break
        held = one_constraint(beyond, held[0].normal, 0.0)
        center, held, moved, budget = relaxed_to_rest(objects, radius, probe, center, held, ROUNDS, budget)
    if held[1].body < 0.0 and moved > SETTLED * radius:  # the last round may have led from an edge onto the face
        center, held, moved, budget = relaxed_to_rest(objects, radius, probe, center, held, 1, budget)
    behind, before = vec3.sub(center, probe), vec3.sub(anchor, probe)
    nearer = vec3.dot(behind, behind) <= (1.0 + INSIDE) * vec3.dot(before, before) + (AT_REST * radius) ** 2
    # Beyond its edge a facet's plane is tilted, and lifts the proxy by the square of that alone: no gap would tell.
    if moved <= AT_REST * radius and on_nearest and nearer and is_a_step(anchor, center, radius):
        gap, _, budget = deepest(objects, center, radius, active_objects(held), budget)
        if gap >= radius * (1.0 - INSIDE):
            return Rest(center, strongest_first(objects, held), False, budget)
    stand = settle_by_planes(objects, radius, probe, anchor, active, budget)
    held = stand.active
    if held[0].body < 0.0:
        held = one_constraint(active[0].body, active[0].normal, 0.0)
    return Rest(stand.center, strongest_first(objects, held), stand.late, stand.budget)


@jit
def facet_under(objects: Any, index: float, x: Vec3) -> float:
    """Place of the facet nearest to `x` (3,) m, walked to over the edges from the one with that place."""
    for _ in range(EDGES):
        beyond = neighbour_on(objects, index, x)
        if beyond == index:
            break
        index = beyond
    return index


@jit
def over_edge(objects: Any, constraint: Constraint, center: Vec3, others: ActiveSet) -> Constraint:
    """The constraint of the facet under a proxy at `center` (3,) m that has crossed the edge of its own."""
    body = constraint.body
    if body < 0.0 or not is_mesh_at(objects, body):
        return constraint
    beyond = facet_under(objects, body, center)
    if beyond == others[0].body or beyond == others[1].body or beyond == others[2].body:
        return constraint
    return Constraint(beyond, constraint.normal, constraint.depth)


@jit
def over_edges(objects: Any, active: ActiveSet, center: Vec3) -> ActiveSet:
    """The constraints of the facets under a proxy at `center` (3,) m."""
    if not any_mesh(objects):
        return active
    one = over_edge(objects, active[0], center, active)
    two = over_edge(objects, active[1], center, (one, active[1], active[2]))
    return one, two, over_edge(objects, active[2], center, (one, two, active[2]))


@jit
def slide_over_facets(
    objects: Any, index: float, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, bool]:
    """`rest_on_curved` on a mesh, from one facet over its edges to the next; False if a proxy that nothing holds aside
    has yet to come to rest."""
    rounds, square = SLIDING_ROUNDS, 0.0
    if deflection == (0.0, 0.0, 0.0):
        rounds, foot = ROUNDS, facet_under(objects, index, probe)
        _, point, foot_normal, _ = closest_to_within(objects, foot, probe, BUDGET)
        if vec3.dot(foot_normal, normal) > SAME_SIDE:
            center = vec3.add_scaled(point, radius, foot_normal)
            return center, pressed(foot, foot_normal, vec3.sub(center, probe)), True
    for _ in range(rounds):
        depth = vec3.dot(vec3.sub(center, probe), normal)
        goal = vec3.add(probe, vec3.add_scaled(vec3.reject(deflection, normal), depth, normal))
        index = facet_under(objects, index, goal)
        _, point, normal, _ = closest_to_within(objects, index, goal, BUDGET)
        moved = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(moved, center)
        center, square = moved, vec3.dot(step, step)
        if square <= (SETTLED * radius) ** 2:
            break
    at_rest = rounds == SLIDING_ROUNDS or square <= (AT_REST * radius) ** 2
    return center, pressed(index, normal, vec3.sub(center, probe)), at_rest


@jit
def is_a_step(start: Vec3, end: Vec3, radius: float) -> bool:
    """Whether a fingertip that is outside at both crosses nothing thin between."""
    way = vec3.sub(end, start)
    return vec3.dot(way, way) <= (STRIDE * radius) ** 2


@jit
def settle_for(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: ActiveSet, left: int
) -> Rest:
    """`settle_among_several` in one step, with what is `left` of the budget."""
    wide = any_multipoint(objects)
    rounds = SLIDING_ROUNDS if wide else ROUNDS
    before, active_before = center, active
    goal = vec3.add(probe, displaced_by(active))
    for _ in range(4):
        hit, stop, left = first_hit(objects, start, goal, radius, True, active_objects(active), left)
        if hit < 0.0:
            break
        _, point, normal, left = closest_to_within(objects, hit, stop, left)
        if count_of(active) == 3:
            # Three constraints already: stop short of the fourth, and let the next tick sort it out.
            goal = stop
            break
        active = with_another(active, hit, normal)
        goal, active, left = relaxed(objects, radius, probe, vec3.add_scaled(point, radius, normal), active, 1, left)
    center = goal
    if not wide:
        # The next of two flush objects holds it from the start: alone the last one would let it fall round its edge.
        near = deepest(objects, goal, radius * (1.0 + INSIDE), active_objects(active), left)
        active, left = with_touched(objects, radius, goal, active, near)
    found, lift, budget = False, 0.0, left
    for attempt in range(ATTEMPTS_ON_MANY if wide else ATTEMPTS):
        center, active, left = relaxed(objects, radius + lift, probe, center, active, rounds, left)
        if wide and attempt == 0:
            center, active = step_over(objects, radius, probe, center, active)
        gap, at, left = deepest(objects, center, radius, active_objects(active), left)
        if gap >= radius * (1.0 - INSIDE):
            found = True
            break
        if left < 0:
            break
        if gap > radius * (1.0 - NEARLY) and (attempt >= SOON or 4 * left < 3 * budget):
            lift = 2.0 * (radius - gap)
        other = at != active[0].body and at != active[1].body and at != active[2].body
        if other or any_creases(objects):
            _, _, normal, left = closest_to_within(objects, at, center, left)
            if other or (has_creases_at(objects, at) and not is_support_point_of(active, at, normal)):
                if count_of(active) == 3:
                    active = without_weakest(active)
                active = with_another(active, at, normal)
    late = not found
    if not found:
        # Pinched only where objects have closed in on the proxy; elsewhere it stays, and the next tick sorts it out.
        gap, _, left = deepest(objects, before, radius, active_objects(active_before), left)
        late = gap >= radius * (1.0 - INSIDE) or left < 0 or not leaves_no_room(active)
        if late:
            center = before
            _, active, left = relaxed(objects, radius, probe, before, active_before, 1, left)
    if any_creases(objects):
        active = merge_support_points(active)
    return Rest(center, strongest_first(objects, active), late, left)


@jit
def step_over(objects: Any, radius: float, probe: Vec3, goal: Vec3, active: ActiveSet) -> tuple[Vec3, ActiveSet]:
    """The proxy's goal (3,) m, and what holds it, after a way over the edge of the facet that holds it alone.

    What is beside the facet is nearer at hand than what a search of the whole mesh finds, which then only agrees.
    """
    for _ in range(EDGES):
        if active[1].body >= 0.0:
            break
        beyond = neighbour_on(objects, active[0].body, goal)
        if beyond == active[0].body:
            break
        active = one_constraint(beyond, active[0].normal, 0.0)
        goal, active = relax(objects, radius, probe, goal, active, 1)
    return goal, active


@jit
def relax(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: ActiveSet, rounds: int
) -> tuple[Vec3, ActiveSet]:
    """`relaxed` for a place that is known to need little of the budget."""
    center, active, _ = relaxed(objects, radius, base, center, active, rounds, BUDGET)
    return center, active


@jit
def relaxed(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: ActiveSet, rounds: int, budget: int
) -> tuple[Vec3, ActiveSet, int]:
    """Nearest point to `base` behind the tangent planes of all holding objects, again and again at the new point. And
    what is left of the budget.

    In a pinch the point between them; see `solve_half_spaces`. In a hollow the probe itself is displaced by what else
    holds the proxy, as in `rest_on_curved`: from the tangent plane a depth of more than the radius that the centre
    moves on would lead away.
    """
    center, active, _, budget = relaxed_to_rest(objects, radius, base, center, active, rounds, budget)
    return center, active, budget


@jit
def seen_from(inside: bool, center: Vec3, base: Vec3, p: float, n: Vec3, q: float, m: Vec3) -> Vec3:
    """Where (3,) m the tangent plane of an object is sought: at the proxy, or of a hollow at the probe, displaced by p
    along n and q along m."""
    return vec3.add_scaled(vec3.add_scaled(base, p, n), q, m) if inside else center


@jit
def relaxed_to_rest(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: ActiveSet, rounds: int, budget: int
) -> tuple[Vec3, ActiveSet, float, int]:
    """`relaxed`, and how far, m, the last round moved the proxy."""
    square = 1e300
    near = (SETTLED * radius) ** 2
    one, two, three = active
    n1, n2, n3 = one.normal, two.normal, three.normal
    push = Depths(one.depth, two.depth, three.depth)
    inside1, inside2, inside3 = (
        is_inside(objects, one.body), is_inside(objects, two.body), is_inside(objects, three.body)
    )  # fmt: skip
    hollow = inside1 or inside2 or inside3
    p1, p2, p3 = 0.0, 0.0, 0.0
    for turn in range(rounds):
        at = seen_from(inside1, center, base, p2, n2, p3, n3)
        point, n1, budget = constraint_of(objects, one.body, at, radius, n1, budget)
        b1 = vec3.dot(n1, vec3.sub(point, base)) + radius
        b2, b3 = b1, b1
        if two.body < 0.0:
            n2 = n1
        else:
            at = seen_from(inside2, center, base, p1, n1, p3, n3)
            point, n2, budget = constraint_of(objects, two.body, at, radius, n2, budget)
            b2 = vec3.dot(n2, vec3.sub(point, base)) + radius
        if three.body < 0.0:
            n3 = n1
        else:
            at = seen_from(inside3, center, base, p1, n1, p2, n2)
            point, n3, budget = constraint_of(objects, three.body, at, radius, n3, budget)
            b3 = vec3.dot(n3, vec3.sub(point, base)) + radius
        if hollow and turn == 0 and rounds > 1:  # what each alone would displace the probe by is near enough to begin
            p1 = max(b1, 0.0)
            p2 = 0.0 if two.body < 0.0 else max(b2, 0.0)
            p3 = 0.0 if three.body < 0.0 else max(b3, 0.0)
            continue
        solution = solve_half_spaces(count_of(active), n1, n2, n3, b1, b2, b3)
        push = solution.push
        p1, p2, p3 = solution.place
        moved = vec3.add(base, displacement(solution.place, n1, n2, n3))
        step = vec3.sub(moved, center)
        center = moved
        square = vec3.dot(step, step)
        if square <= near:
            break
    held = (
        Constraint(one.body, n1, push.first),
        Constraint(two.body, n2, push.second),
        Constraint(three.body, n3, push.third),
    )
    return center, held, sqrt(square), budget


@jit
def drawn_after(objects: Any, active: ActiveSet, behind: Vec3) -> Vec3:
    """Force (3,) N beside what the constraints bear, on a probe whose proxy is late and `behind` (3,) m away from it.

    Planes that hold the proxy change as it goes its way round; its distance from the probe does not jump, and so does
    the force of a spring between the two.
    """
    distance, (one, two, three) = vec3.norm(behind), loads_of(objects, active)
    pull = 0.0
    if distance > 0.0:
        pull = spring(normal_law_of(objects, active[0].body), distance) / distance
    borne = displacement(Depths(one, two, three), active[0].normal, active[1].normal, active[2].normal)
    return vec3.sub(vec3.scale(pull, behind), borne)
