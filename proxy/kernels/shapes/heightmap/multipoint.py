"""Rest position of the proxy on a height map, which may touch the fingertip at several points at once.

Hills may be closer together than the fingertip's diameter, and valleys more curved than the fingertip. So the offset
surface has creases, where the fingertip touches two or three support points, and a single nearest point does not
constrain it. The rest position is found by cutting planes. Each iteration takes the tangent planes of the support
points, moved out by r, and computes the point behind none of them that is closest to the goal given by probe and
friction. There it updates the support points, and adds the nearest point of the map if that is closer than r. With one
support point, the curvature of the offset surface makes this Newton's method. The final position is checked against the
entire map, so the proxy is never inside. No step exceeds the fingertip's clearance, so it cannot jump over a ridge.

The searches have budgets, counted as in `nearest`: one for the rest position, one for the end of a roll, and that of
meshes for a first contact. If a budget is exhausted, the proxy stops at its last position known to be outside, and the
next tick repeats the search.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of, turn_into, turn_out_of
from softfinger.proxy.kernels.numerics.half_spaces import solve_half_spaces
from softfinger.proxy.kernels.shapes.budget import INSIDE_TOLERANCE, MAX_STRIDE, SETTLED_STEP
from softfinger.proxy.kernels.shapes.composite import raised_clear
from softfinger.proxy.kernels.shapes.heightmap.nearest import (
    compute_gap_within,
    compute_remaining_budget,
    find_foot_from,
    find_nearest_from,
    find_point_above,
)
from softfinger.proxy.kernels.shapes.protocol import (
    MAX_ADVANCES,
    NO_HIT,
    TOUCHING_CLEARANCE,
    compute_direction,
    curvature,
    follows,
    meets,
    rest_on,
)

MAX_CREASE_ROUNDS: Final = 8
"""Limit of the iterations of cutting planes in a tick: two or three with one support point, about five in a crease."""
FIRST_SLIDING_ROUND: Final = 1
"""First iteration after which a sliding proxy may stop: the next tick corrects the remaining error."""
SAME_POINT_DISTANCE: Final = 1e-6
"""Distance, as a share of the radius, within which two support points count as one."""
SUPPORT_TOLERANCE: Final = 1e-9
"""Tolerance at the start of a roll for the support point: distance as a share of the radius, and 1 - cosine of the
normal's deviation."""
REST_BUDGET: Final = 1000
"""Budget of `rest_on_support_points`, for all iterations together, in tiles."""
ROLL_BUDGET: Final = 300
"""Budget of the check for room at the end of a roll."""
END_BUDGET: Final = 200
"""Budget of the check for room at the end of the path to a first contact."""
MIN_STEP_FACTOR: Final = 0.25
"""Lower bound of 1 - depth x curvature: Newton's step is at most four times the step in the tangent plane."""


class SupportPoints(NamedTuple):
    """Surface points (3,) m that touch the fingertip; `point_count` is their number."""

    point_count: int
    first: Vec3
    second: Vec3
    third: Vec3


@jit
def is_support_point(feet: SupportPoints, point: Vec3, within: float) -> bool:
    """Return True if `point` is within a distance (m) of one of the support points."""
    if vec3.norm(vec3.sub(point, feet.first)) <= within:
        return True
    if feet.point_count > 1 and vec3.norm(vec3.sub(point, feet.second)) <= within:
        return True
    return feet.point_count > 2 and vec3.norm(vec3.sub(point, feet.third)) <= within


@jit
def with_support_point(feet: SupportPoints, point: Vec3) -> SupportPoints:
    """Add a support point; of three, replace the last."""
    if feet.point_count == 1:
        return SupportPoints(2, feet.first, point, point)
    return SupportPoints(3, feet.first, feet.second, point)


@jit
def step_on_one_point(shape: Any, radius: float, goal: Vec3, foot: Vec3, normal: Vec3) -> Vec3:
    """Return the centre (3,) m closest to `goal` on one support point, by a Newton step on the offset surface."""
    center = vec3.add_scaled(foot, radius, normal)
    offset = vec3.sub(goal, center)
    depth = max(-vec3.dot(offset, normal), 0.0)
    k1, k2, d1 = curvature(shape, radius, foot, normal)
    d2 = vec3.cross(normal, d1)
    first = vec3.dot(offset, d1) / max(1.0 - depth * k1, MIN_STEP_FACTOR)
    second = vec3.dot(offset, d2) / max(1.0 - depth * k2, MIN_STEP_FACTOR)
    return vec3.add_scaled(vec3.add_scaled(center, first, d1), second, d2)


@jit
def clamp_length(vector: Vec3, longest: float) -> Vec3:
    length = vec3.norm(vector)
    return vec3.scale(longest / length, vector) if length > longest else vector


@jit
def solve_support_points(
    feet: SupportPoints, radius: float, goal: Vec3, n1: Vec3, n2: Vec3, n3: Vec3
) -> tuple[Vec3, Vec3]:
    """Return push (3,) m and centre (3,) m closest to `goal` on the tangent planes of two or three support points."""
    b1 = vec3.dot(n1, vec3.sub(feet.first, goal)) + radius
    b2 = vec3.dot(n2, vec3.sub(feet.second, goal)) + radius
    b3 = vec3.dot(n3, vec3.sub(feet.third, goal)) + radius
    solution = solve_half_spaces(feet.point_count, n1, n2, n3, b1, b2, b3)
    return vec3.weighted_sum(solution.push, n1, n2, n3), vec3.add(goal, vec3.weighted_sum(solution.weights, n1, n2, n3))


@outlined
def rest_on_support_points(
    shape: Any, radius: float, probe: Vec3, center: Vec3, lag: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    """Find the rest position of the centre near `center`, in the frame of the shape.

    lag      (3,)  m  deflection by friction: the goal is the probe plus the tangential part of it
    returns  proxy (3,) m, normal (3,), and 1 if the budget was exhausted before a position with room was found
    """
    rest, up, slides = center, normal, lag != (0.0, 0.0, 0.0)
    budget, budget_exhausted = REST_BUDGET, 0.0
    feet = SupportPoints(1, vec3.add_scaled(center, -radius, normal), center, center)
    for iteration in range(MAX_CREASE_ROUNDS):
        _, p1, n1, _, cost = find_foot_from(shape, center, feet.first)
        budget -= cost
        p2, n2, p3, n3 = p1, n1, p1, n1
        if feet.point_count > 1:
            _, p2, n2, _, cost = find_foot_from(shape, center, feet.second)
            budget -= cost
            p3, n3 = p2, n2
        if feet.point_count > 2:
            _, p3, n3, _, cost = find_foot_from(shape, center, feet.third)
            budget -= cost
        feet = SupportPoints(feet.point_count, p1, p2, p3)
        clear = True
        if iteration > 0:
            gap, nearest_point, nearest_normal, _, cost = find_nearest_from(shape, center, p1, budget)
            budget -= cost
            clear = gap >= radius * (1.0 - INSIDE_TOLERANCE)
            if budget <= 0 and not clear:
                budget_exhausted = 1.0
                is_inside = vec3.norm(vec3.sub(rest, nearest_point)) < radius * (1.0 - SAME_POINT_DISTANCE)
                if is_inside:  # the start was inside: move up and out
                    rest = find_point_above(shape, rest, radius)
                break
            if not clear and not is_support_point(feet, nearest_point, SAME_POINT_DISTANCE * radius):
                feet = with_support_point(feet, nearest_point)
                n3 = nearest_normal
                if feet.point_count == 2:
                    n2 = nearest_normal
        goal = vec3.add(probe, vec3.reject(lag, up))
        if feet.point_count == 1:
            push, target = n1, step_on_one_point(shape, radius, goal, p1, n1)
        else:
            push, target = solve_support_points(feet, radius, goal, n1, n2, n3)
        if iteration > 0 and clear:
            rest = center
            _, up = compute_direction(push, n1)
        target = vec3.add(rest, clamp_length(vec3.sub(target, rest), MAX_STRIDE * radius))
        if feet.point_count == 1:
            _, p1, n1, _, cost = find_foot_from(shape, target, p1)
            budget -= cost
            landed = vec3.add_scaled(p1, radius, n1)
            if vec3.norm(vec3.sub(landed, rest)) <= radius:
                target = landed
        step = vec3.norm(vec3.sub(target, center))
        if iteration > 0 and clear and (step <= SETTLED_STEP * radius or (slides and iteration >= FIRST_SLIDING_ROUND)):
            break
        center = target
    return rest, up, budget_exhausted


@follows.of(Heightmap)
def follows_over_heightmap(shape: Heightmap, radius: float, start: Vec3, normal: Vec3, end: Vec3) -> bool:
    """Allow a roll from a single support point, at most a stride long, to a position with room for the fingertip."""
    foot = vec3.add_scaled(start, -radius, normal)
    _, point, up, _, _ = find_foot_from(shape, start, foot)
    if vec3.norm(vec3.sub(point, foot)) > SUPPORT_TOLERANCE * radius or vec3.dot(up, normal) < 1.0 - SUPPORT_TOLERANCE:
        return False
    distance = vec3.norm(vec3.sub(end, start))
    if distance > MAX_STRIDE * radius:
        return False
    gap, _, _, _, _ = find_nearest_from(shape, end, point, ROLL_BUDGET)
    return gap >= radius * (1.0 - INSIDE_TOLERANCE)


@raised_clear.of(Heightmap)
def raised_clear_of_heightmap(shape: Heightmap, x: Vec3, radius: float) -> Vec3:
    return find_point_above(shape, x, radius)


@meets.of(Heightmap)
def meets_heightmap(
    shape: Heightmap, start: Vec3, end: Vec3, radius: float, in_contact: bool, budget: int
) -> tuple[float, float, int]:
    """Use conservative advancement as `travel` does, but search only as far as the remaining path.

    With `in_contact`, a short path is never a hit, as on a mesh: the rest position handles contacts at its end. The
    path may use half of the budget. If that is exhausted, the fingertip stops there; a short path, which cannot cross
    the surface, is allowed if there is room at its end.
    """
    path = vec3.sub(end, start)
    length, short = vec3.norm(path), MAX_STRIDE * radius
    if in_contact and length <= short:
        return NO_HIT, 0.0, budget
    near = compute_gap_within(shape, start, radius + length, budget // 2)
    path_budget = compute_remaining_budget(budget // 2, near.is_complete, near.cost)
    budget = compute_remaining_budget(budget, True, near.cost)
    clearance, touching, share = near.gap - radius, TOUCHING_CLEARANCE * radius, 0.0
    if clearance >= length:
        return NO_HIT, 0.0, budget
    limit = min(clearance, 0.0) if in_contact else 0.0
    for _ in range(MAX_ADVANCES if clearance > touching else 0):
        if path_budget < 0:
            break
        share += clearance / length
        if share >= 1.0:
            return NO_HIT, 0.0, budget
        near = compute_gap_within(
            shape, vec3.add_scaled(start, share, path), radius + (1.0 - share) * length, path_budget
        )
        path_budget = compute_remaining_budget(path_budget, near.is_complete, near.cost)
        budget = compute_remaining_budget(budget, True, near.cost)
        clearance = near.gap - radius
        if path_budget >= 0 and clearance <= touching:
            return share, 0.0, budget
    if path_budget < 0 and length > short:
        return share, 0.0, budget
    # A grazing path gets closer in ever smaller steps: it is a hit only if it ends inside.
    near = compute_gap_within(shape, end, radius, min(budget, END_BUDGET))
    return (share if near.gap - radius < limit else NO_HIT), 0.0, compute_remaining_budget(budget, True, near.cost)


@rest_on.of(Heightmap)
def rest_on_heightmap(
    shape: Heightmap, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3, float]:
    rest, up, budget_exhausted = rest_on_support_points(
        shape, radius, into(pose, probe), into(pose, center), turn_into(pose, deflection), turn_into(pose, normal)
    )
    return out_of(pose, rest), turn_out_of(pose, up), budget_exhausted
