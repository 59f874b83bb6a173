"""Which objects hold the proxy, how hard, and where it comes to rest.

The proxy is the point nearest the probe that satisfies every constraint. One object is the common case and is solved
on its own, friction's deflection included; with several, the objects that held the proxy last are kept and asked
again, what stands in the way is added, and the smallest push that satisfies them all is found, until nothing changes.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.half_spaces import FACING, Push, displacement, hold
from softfinger.proxy.kernels.contact.lodged import lodge
from softfinger.proxy.kernels.contact.normal import spring
from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.geometry.bodies import (
    any_rugged,
    any_wide,
    beside_on,
    closest_on,
    closest_to,
    closest_to_within,
    deepest,
    held_by_at,
    material_of,
    rugged_on,
)
from softfinger.proxy.kernels.geometry.frames import into, out_of, turn_into, turn_out_of
from softfinger.proxy.kernels.geometry.mesh.contact import STRIDE
from softfinger.proxy.kernels.geometry.mesh.query import BUDGET
from softfinger.proxy.kernels.geometry.surfaces import is_hollow, rest_on
from softfinger.proxy.kernels.geometry.surfaces.contract import direction
from softfinger.proxy.kernels.geometry.sweep import first_hit
from softfinger.proxy.kernels.model import Heightmap, Plane, Vec3
from softfinger.proxy.kernels.native.jit import jit

ROUNDS = 10
"""Linearisations of curved surfaces at the proxy; each gains the digits that depth over radius of curvature allows."""
SLIDING_ROUNDS = 2
"""The same for a proxy that slides, and on meshes and height maps: what is left is far below the slip of one tick, and
the next tick takes it up. Short of the end the proxy is outside, not inside."""
SAME_SIDE = 0.5
"""Cosine between two normals of one side of an object, one tick apart: a fingertip does not turn round it in a tick."""
SETTLED = 1e-13
"""Movement, as a share of the fingertip's radius, below which the proxy is at rest."""
INSIDE = 1e-10
"""Depth, as a share of the fingertip's radius, that counts as inside an object and not as rounding."""
FLAT = 1e-4
"""Volume spanned by three unit normals below which they lie in a plane, and may close in from all sides of it."""
ATTEMPTS, ATTEMPTS_ON_MANY = 4, 16
"""Times that something found in the way is added to what holds the proxy, before it stays where it was for a tick."""
SOON, NEARLY = 3, 1e-4
"""Attempts after which, or after a quarter of the budget, and depth, as a share of the fingertip's radius, below which
a proxy among more than three facets that are about as near is lifted off those that hold it: of the others each would
be in the way in turn."""
SAME_FOOT = 1.0 - 1e-4
"""Cosine between the normals of two feet on a height map above which they are taken for one."""
EDGES = 3
"""Edges that a fingertip goes over in a tick before all of the mesh is asked."""
NONE = -1.0


class Constraints(NamedTuple):
    """Objects that hold the proxy. While its rest is searched a height map may be several of them, one for each foot.

    first, second, third   places in the scene's tuple, -1 for none; the first is the one that is rolled on
    n1, n2, n3             (3,) 1   normals
    push                   m        weights: how far the probe lies behind the proxy along each normal
    """

    first: float
    second: float
    third: float
    n1: Vec3
    n2: Vec3
    n3: Vec3
    push: Push


class Rest(NamedTuple):
    """Where the proxy (3,) m comes to rest and what holds it there; if it is `late`, a place on the way, or where it
    was since nothing better was found to be outside. And what is left of the budget, below 0 where it was used up."""

    center: Vec3
    active: Constraints
    late: bool
    left: int


@jit
def one_constraint(first: float, normal: Vec3) -> Constraints:
    """One object alone, not yet pressed."""
    return Constraints(first=first, second=NONE, third=NONE, n1=normal, n2=normal, n3=normal, push=Push(0.0, 0.0, 0.0))


@jit
def count_of(active: Constraints) -> int:
    if active.second < 0.0:
        return 1
    return 2 if active.third < 0.0 else 3


@jit
def pressed(normal: Vec3, behind: Vec3) -> Constraints:
    """The only object, for a proxy on it that lies `behind` (3,) m ahead of the probe."""
    push = Push(max(vec3.dot(behind, normal), 0.0), 0.0, 0.0)
    return Constraints(first=0.0, second=NONE, third=NONE, n1=normal, n2=normal, n3=normal, push=push)


@jit
def settle_on_one(
    objects: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, active: Constraints, slips: bool
) -> tuple[Vec3, Constraints, float]:
    """Bring the proxy to rest on the only object; and 1 if its search had to stop before that was found.

    center      (3,) m  where its roll has brought it
    deflection  (3,) m  what friction keeps between proxy and probe, tangent
    slips               False where friction holds it
    """
    if not slips:
        return center, active, 0.0
    center, normal, bounded = rest_on(objects[0].shape, objects[0], radius, probe, center, deflection, active.n1)
    return center, pressed(normal, vec3.sub(center, probe)), bounded


@rest_on.of(Plane)
def rest_on_plane(
    shape: Plane, body: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Found from the probe alone, so that a tick does not wait for the last one's proxy."""
    gap, _, normal = closest_on(body, probe)
    return vec3.add(probe, vec3.add_scaled(deflection, radius - gap, normal)), normal, 0.0


@rest_on.otherwise
def rest_on_curved(
    shape: Any, body: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Project the probe onto the tangent plane, put that onto the surface, and again from there.

    In a hollow the probe itself is displaced, not its image in the tangent plane: the surface through the probe is the
    flatter one there, and the foot from it is Newton's step. From the tangent plane a depth of more than the radius
    that the centre moves on would lead away.

    Without a deflection the answer is the surface point nearest to the probe, unless that one is on another
    side of the object: then the normal has jumped, and the proxy goes its way round.
    """
    if deflection == (0.0, 0.0, 0.0):
        _, point, foot_normal = closest_on(body, probe)
        if vec3.dot(foot_normal, normal) > SAME_SIDE:
            return vec3.add_scaled(point, radius, foot_normal), foot_normal, 0.0
    near, rounds = (SETTLED * radius) ** 2, SLIDING_ROUNDS
    if deflection == (0.0, 0.0, 0.0):
        rounds = ROUNDS
    hollow = is_hollow(shape)
    for _ in range(rounds):
        depth = 0.0 if hollow else vec3.dot(vec3.sub(center, probe), normal)
        goal = vec3.add(probe, vec3.add_scaled(vec3.reject(deflection, normal), depth, normal))
        _, point, normal = closest_on(body, goal)
        moved = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(moved, center)
        center = moved
        if vec3.dot(step, step) <= near:
            break
    return center, normal, 0.0


@rest_on.of(Heightmap)
def rest_on_heightmap(
    shape: Heightmap, body: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    pose = body.pose
    rest, up, bounded = lodge(
        shape, radius, into(pose, probe), into(pose, center), turn_into(pose, deflection), turn_into(pose, normal)
    )
    return out_of(pose, rest), turn_out_of(pose, up), bounded


@jit
def settle_among_several(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: Constraints, left: int
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
    if not any_wide(objects):
        return settle_for(objects, radius, probe, start, center, active, left)
    rest, whole, held = Rest(center, active, True, 0), probe, active
    for budget in (3 * left // 4, left // 4):
        goal = vec3.add(whole, displacement(held.push, held.n1, held.n2, held.n3))
        if is_a_step(center, goal, radius):
            rest = settle_for(objects, radius, whole, start, center, held, budget)
            if not is_a_step(center, rest.center, radius):  # it may be on the other side of something
                rest = Rest(center, active, True, rest.left)
        if not rest.late:
            break
        deep = vec3.sub(probe, center)
        whole = vec3.add_scaled(center, min(0.5 * STRIDE * radius / vec3.norm(deep), 0.5), deep)
        _, held, _ = relaxed(objects, radius, whole, center, active, 1, rest.left)
    if whole == probe:
        return rest
    _, held, _ = relaxed(objects, radius, probe, rest.center, rest.active, 1, rest.left)
    return Rest(rest.center, held, True, rest.left)


@jit
def is_a_step(start: Vec3, end: Vec3, radius: float) -> bool:
    """Whether a fingertip that is outside at both crosses nothing thin between."""
    way = vec3.sub(end, start)
    return vec3.dot(way, way) <= (STRIDE * radius) ** 2


@jit
def settle_for(
    objects: Any, radius: float, probe: Vec3, start: Vec3, center: Vec3, active: Constraints, left: int
) -> Rest:
    """`settle_among_several` in one step, with what is `left` of the budget."""
    wide = any_wide(objects)
    rounds = SLIDING_ROUNDS if wide else ROUNDS
    before, active_before = center, active
    goal = vec3.add(probe, displacement(active.push, active.n1, active.n2, active.n3))
    for _ in range(4):
        hit, stop, left = first_hit(objects, start, goal, radius, True, held_by(active), left)
        if hit < 0.0:
            break
        _, point, normal, left = closest_to_within(objects, hit, stop, left)
        if active.second >= 0.0 and active.third >= 0.0:
            # Three constraints already: stop short of the fourth, and let the next tick sort it out.
            goal = stop
            break
        active = with_another(active, hit, normal)
        goal, active, left = relaxed(objects, radius, probe, vec3.add_scaled(point, radius, normal), active, 1, left)
    center = goal
    if not wide:
        # The next of two flush objects holds it from the start: alone the last one would let it fall round its edge.
        gap, at, left = deepest(objects, goal, radius * (1.0 + INSIDE), held_by(active), left)
        active = with_touched(objects, radius, goal, active, gap, at)
    found, lift, budget = False, 0.0, left
    for attempt in range(ATTEMPTS_ON_MANY if wide else ATTEMPTS):
        center, active, left = relaxed(objects, radius + lift, probe, center, active, rounds, left)
        if wide and attempt == 0:
            center, active = step_over(objects, radius, probe, center, active)
        gap, at, left = deepest(objects, center, radius, held_by(active), left)
        if gap >= radius * (1.0 - INSIDE):
            found = True
            break
        if left < 0:
            break
        if gap > radius * (1.0 - NEARLY) and (attempt >= SOON or 4 * left < 3 * budget):
            lift = 2.0 * (radius - gap)
        other = at != active.first and at != active.second and at != active.third
        if other or any_rugged(objects):
            _, _, normal, left = closest_to_within(objects, at, center, left)
            if other or (rugged_on(objects, at) and not stands_on(active, at, normal)):
                if active.second >= 0.0 and active.third >= 0.0:
                    active = without_weakest(active)
                active = with_another(active, at, normal)
    late = not found
    if not found:
        # Pinched only where objects have closed in on the proxy; elsewhere it stays, and the next tick sorts it out.
        gap, _, left = deepest(objects, before, radius, held_by(active_before), left)
        late = gap >= radius * (1.0 - INSIDE) or left < 0 or not leaves_no_room(active)
        if late:
            center = before
            _, active, left = relaxed(objects, radius, probe, before, active_before, 1, left)
    if any_rugged(objects):
        active = one_foot_each(active)
    return Rest(center, strongest_first(objects, active), late, left)


@jit
def stands_on(active: Constraints, at: float, normal: Vec3) -> bool:
    """Whether that place of the height map `at`, given by its normal, is one of the feet."""
    if at == active.first and vec3.dot(normal, active.n1) > SAME_FOOT:
        return True
    if at == active.second and vec3.dot(normal, active.n2) > SAME_FOOT:
        return True
    return at == active.third and vec3.dot(normal, active.n3) > SAME_FOOT


@jit
def one_foot_each(active: Constraints) -> Constraints:
    """The feet on one height map together: pushing along the sum of their pushes, by its length."""
    push = active.push
    if active.third >= 0.0 and (active.third == active.first or active.third == active.second):
        if active.third == active.first:
            first, n1 = together(push.first, active.n1, push.third, active.n3)
            second, n2 = push.second, active.n2
        else:
            first, n1 = push.first, active.n1
            second, n2 = together(push.second, active.n2, push.third, active.n3)
        active = Constraints(
            first=active.first, second=active.second, third=NONE, n1=n1, n2=n2, n3=n2, push=Push(first, second, 0.0)
        )  # fmt: skip
    if active.second >= 0.0 and active.second == active.first:
        push = active.push
        first, n1 = together(push.first, active.n1, push.second, active.n2)
        active = Constraints(
            first=active.first, second=active.third, third=NONE, n1=n1, n2=active.n3, n3=active.n3,
            push=Push(first, push.third, 0.0),
        )  # fmt: skip
    return active


@jit
def together(one: float, n1: Vec3, two: float, n2: Vec3) -> tuple[float, Vec3]:
    return direction(vec3.add_scaled(vec3.scale(one, n1), two, n2), n1)


@jit
def step_over(objects: Any, radius: float, probe: Vec3, goal: Vec3, active: Constraints) -> tuple[Vec3, Constraints]:
    """The proxy's goal (3,) m, and what holds it, after a way over the edge of the facet that holds it alone.

    What is beside the facet is nearer at hand than what a search of the whole mesh finds, which then only agrees.
    """
    for _ in range(EDGES):
        if active.second >= 0.0:
            break
        beyond = beside_on(objects, active.first, goal)
        if beyond == active.first:
            break
        active = one_constraint(beyond, active.n1)
        goal, active = relax(objects, radius, probe, goal, active, 1)
    return goal, active


@jit
def held_by(active: Constraints) -> Vec3:
    """Places of the objects, -1 for none."""
    return active.first, active.second, active.third


@jit
def leaves_no_room(active: Constraints) -> bool:
    """Whether two that hold the proxy face each other, or three close in on it from all sides."""
    if active.second < 0.0:
        return False
    if vec3.dot(active.n1, active.n2) < FACING:
        return True
    if active.third < 0.0:
        return False
    across = vec3.cross(active.n1, active.n2)
    return (
        vec3.dot(active.n1, active.n3) < FACING
        or vec3.dot(active.n2, active.n3) < FACING
        or abs(vec3.dot(across, active.n3)) < FLAT
    )


@jit
def relax(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: Constraints, rounds: int
) -> tuple[Vec3, Constraints]:
    """`relaxed` for a place that is known to need little of the budget."""
    center, active, _ = relaxed(objects, radius, base, center, active, rounds, BUDGET)
    return center, active


@jit
def relaxed(
    objects: Any, radius: float, base: Vec3, center: Vec3, active: Constraints, rounds: int, left: int
) -> tuple[Vec3, Constraints, int]:
    """Nearest point to `base` behind the tangent planes of all holding objects, again and again at the new point. And
    what is left of the budget.

    In a pinch the point between them; see `hold`.
    """
    near = (SETTLED * radius) ** 2
    n1, n2, n3 = active.n1, active.n2, active.n3
    push = active.push
    for _ in range(rounds):
        point, n1, left = held_by_at(objects, active.first, center, radius, n1, left)
        b1 = vec3.dot(n1, vec3.sub(point, base)) + radius
        b2, b3 = b1, b1
        if active.second < 0.0:
            n2 = n1
        else:
            point, n2, left = held_by_at(objects, active.second, center, radius, n2, left)
            b2 = vec3.dot(n2, vec3.sub(point, base)) + radius
        if active.third < 0.0:
            n3 = n1
        else:
            point, n3, left = held_by_at(objects, active.third, center, radius, n3, left)
            b3 = vec3.dot(n3, vec3.sub(point, base)) + radius
        held = hold(count_of(active), n1, n2, n3, b1, b2, b3)
        push = held.push
        moved = vec3.add(base, displacement(held.place, n1, n2, n3))
        step = vec3.sub(moved, center)
        center = moved
        if vec3.dot(step, step) <= near:
            break
    return center, Constraints(
        first=active.first, second=active.second, third=active.third, n1=n1, n2=n2, n3=n3, push=push
    ), left  # fmt: skip


@jit
def with_another(active: Constraints, index: float, normal: Vec3) -> Constraints:
    if active.second < 0.0:
        return Constraints(
            first=active.first, second=index, third=NONE, n1=active.n1, n2=normal, n3=normal, push=active.push
        )  # fmt: skip
    return Constraints(
        first=active.first, second=active.second, third=index, n1=active.n1, n2=active.n2, n3=normal,
        push=active.push,
    )  # fmt: skip


@jit
def with_touched(objects: Any, radius: float, center: Vec3, active: Constraints, gap: float, at: float) -> Constraints:
    """And the object nearest to the proxy, `at` with that gap, if it touches it and there is room for one more."""
    if gap > radius * (1.0 + INSIDE) or active.third >= 0.0 or at == active.first or at == active.second:
        return active
    _, _, normal = closest_to(objects, at, center)
    return with_another(active, at, normal)


@jit
def without_weakest(active: Constraints) -> Constraints:
    """Let go of the one of three that pushes least, to make room."""
    push = active.push
    if push.third <= push.second and push.third <= push.first:
        return Constraints(
            first=active.first, second=active.second, third=NONE, n1=active.n1, n2=active.n2, n3=active.n2, push=push
        )  # fmt: skip
    if push.second <= push.first:
        return Constraints(
            first=active.first, second=active.third, third=NONE, n1=active.n1, n2=active.n3, n3=active.n3, push=push
        )  # fmt: skip
    return Constraints(
        first=active.second, second=active.third, third=NONE, n1=active.n2, n2=active.n3, n3=active.n3, push=push
    )  # fmt: skip


@jit
def swapped(active: Constraints, third: bool) -> Constraints:
    """The second or the third of them first."""
    push = active.push
    if third:
        return Constraints(
            first=active.third, second=active.second, third=active.first, n1=active.n3, n2=active.n2, n3=active.n1,
            push=Push(push.third, push.second, push.first),
        )  # fmt: skip
    return Constraints(
        first=active.second, second=active.first, third=active.third, n1=active.n2, n2=active.n1, n3=active.n3,
        push=Push(push.second, push.first, push.third),
    )  # fmt: skip


@jit
def loads_of(objects: Any, active: Constraints) -> Vec3:
    """Elastic normal forces, N, of the three; 0 for none."""
    one = spring(material_of(objects, active.first).normal, active.push.first)
    two, three = 0.0, 0.0
    if active.second >= 0.0:
        two = spring(material_of(objects, active.second).normal, active.push.second)
    if active.third >= 0.0:
        three = spring(material_of(objects, active.third).normal, active.push.third)
    return one, two, three


@jit
def drawn_after(objects: Any, active: Constraints, behind: Vec3) -> Vec3:
    """Force (3,) N beside what the constraints bear, on a probe whose proxy is late and `behind` (3,) m away from it.

    Planes that hold the proxy change as it goes its way round; its distance from the probe does not jump, and so does
    the force of a spring between the two.
    """
    distance, (one, two, three) = vec3.norm(behind), loads_of(objects, active)
    pull = 0.0
    if distance > 0.0:
        pull = spring(material_of(objects, active.first).normal, distance) / distance
    borne = displacement(Push(one, two, three), active.n1, active.n2, active.n3)
    return vec3.sub(vec3.scale(pull, behind), borne)


@jit
def strongest_first(objects: Any, active: Constraints) -> Constraints:
    """Drop what does not push, and let another be the first only when that has clearly come to bear more.

    A plain comparison would change between two equal walls with every rounding error.
    """
    load = loads_of(objects, active)
    if active.second >= 0.0 and load[1] > 1.5 * load[0] and load[1] >= load[2]:
        active = swapped(active, False)
    elif active.third >= 0.0 and load[2] > 1.5 * load[0]:
        active = swapped(active, True)
    if active.third >= 0.0 and not active.push.third > 0.0:
        active = Constraints(
            first=active.first, second=active.second, third=NONE, n1=active.n1, n2=active.n2, n3=active.n2,
            push=Push(active.push.first, active.push.second, 0.0),
        )  # fmt: skip
    if active.second >= 0.0 and not active.push.second > 0.0:
        active = Constraints(
            first=active.first, second=active.third, third=NONE, n1=active.n1, n2=active.n3, n3=active.n3,
            push=Push(active.push.first, active.push.third, 0.0),
        )  # fmt: skip
    return active


@jit
def tangent_to_all(active: Constraints, v: Vec3) -> Vec3:
    """Part of `v` along which all holding objects leave the proxy free."""
    v = vec3.reject(v, active.n1)
    if active.second >= 0.0:
        across = vec3.reject(active.n2, active.n1)
        size = vec3.dot(across, across)
        if size > 1e-18:
            v = vec3.add_scaled(v, -vec3.dot(v, across) / size, across)
            if active.third >= 0.0:
                return (0.0, 0.0, 0.0)
    return v
