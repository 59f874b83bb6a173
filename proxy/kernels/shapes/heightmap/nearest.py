"""Nearest point of a height map, and the distance to it, within a budget.

The search visits tiles (`tiles`) depth first, the closer ones of four first. It needs no stack: the next tile follows
from the indices of the current one. It skips tiles that cannot contain the nearest point, and runs Newton's method in
the remaining cells.

A visited tile costs 1 of the budget, an evaluated height HEIGHT_COST; a unit takes about as long as a node of a mesh.
If the budget is exhausted, the result is the best foot point so far and a lower bound: the smallest possible distance
of a skipped tile. The surface then counts as that close, in the direction of the best foot point. So contact may start
a little early, never late, and the proxy is outside.
"""

from math import sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.budget import NO_BUDGET
from softfinger.proxy.kernels.shapes.composite import NearestObject, nearest_of_shape
from softfinger.proxy.kernels.shapes.heightmap.surface import (
    MapFoot,
    MapPoint,
    compute_gap_at_foot,
    descend,
    find_foot,
    is_below,
    to_pitches,
)
from softfinger.proxy.kernels.shapes.heightmap.tiles import (
    EQUAL_SQUARE_SHARE,
    MAX_LEVELS,
    NO_DISTANCE,
    choose_nearer_half,
    compute_squared_distance,
    contains_foot,
    count_tiles,
    find_tile,
    find_tiles_around,
    is_convex_around,
    is_farther,
    to_facet,
)
from softfinger.proxy.kernels.shapes.protocol import (
    closest_from,
    closest_or_bound,
    closest_within,
    compute_direction,
    constraint_at,
)

HEIGHT_COST: Final = 2
"""Cost of a height evaluation, in tiles; a tile takes about 10 ns."""
NEIGHBOUR_COST: Final = 4
"""Cost of the check of the tiles round a foot point."""
QUERY_BUDGET: Final = 700
"""Budget of a query for the nearest point without contact."""
LIFT_TILES: Final = 8
"""Tiles per side, less one, that are checked to lift a fingertip above the surface under it."""
MAX_DESCENT: Final = 2.0
"""Largest distance, in cells, of a descent from a cell; a foot point farther away is found from another cell."""
LIMIT_MARGIN: Final = 1.0 + 1e-9
"""Factor on a search limit, so that rounding does not exclude a point at the limit."""


class MapSearch(NamedTuple):
    """Nearest foot point, or the best found so far if the budget was exhausted.

    bound        lower bound of the distance, in pitches
    is_complete  True if the budget was sufficient
    cost         of the search
    """

    foot: MapFoot
    bound: float
    is_complete: bool
    cost: int


class TouchedPoint(NamedTuple):
    """Gap (m), point (3,) m and normal (3,) as of `closest`, and the cost.

    is_complete  True if the budget was sufficient; otherwise gap is a lower bound, and point the nearest known
    cost         of the search
    """

    gap: float
    point: Vec3
    normal: Vec3
    is_complete: bool
    cost: int


class Gap(NamedTuple):
    """Gap, and the cost of finding it.

    gap          m  a lower bound unless `is_complete`
    is_complete     True if the budget was sufficient
    cost            of the search
    """

    gap: float
    is_complete: bool
    cost: int


@jit
def compute_remaining_budget(budget: int, is_complete: bool, cost: int) -> int:
    """Return the remaining budget after a query, below 0 if this query or an earlier one exhausted it."""
    return NO_BUDGET if budget < 0 or not is_complete else max(budget - cost, 0)


@jit
def find_best_quarter(shape: Heightmap, p: Vec3, start: MapFoot, i: int, j: int) -> MapFoot:
    """Return the closest of `start` and the middles of the cell's quarters, from which to descend to its foot point."""
    for number in range(4):
        candidate = find_foot(shape, p, i + 0.25 + 0.5 * (number & 1), j + 0.25 + 0.5 * (number >> 1))
        if candidate.squared_distance < start.squared_distance:
            start = candidate
    return start


@outlined
def search(shape: Heightmap, p: Vec3, best: MapFoot, budget: int) -> MapSearch:
    """Return the nearest foot point, or `best` if none is closer, and a lower bound of the distance."""
    top = int(shape.levels) - 1
    level, i, j = top, 0, 0
    cost, unsearched, reach = 0, NO_DISTANCE, sqrt(best.squared_distance)
    for _ in range(max(budget, 0) + 4 * MAX_LEVELS):
        cost += 1
        if i < count_tiles(shape.columns, level) and j < count_tiles(shape.rows, level):
            tile = find_tile(shape, p, level, i, j)
            square, offset = compute_squared_distance(tile), MapPoint(0.0, 0.0)
            asks = square < EQUAL_SQUARE_SHARE * best.squared_distance and not (
                tile.convex and contains_foot(tile, best)
            )
            if asks:
                square, offset = to_facet(tile)
            if asks and square < (reach + tile.thick) * (reach + tile.thick) * EQUAL_SQUARE_SHARE:
                if cost >= budget:
                    unsearched = min(unsearched, max(sqrt(square) - tile.thick, 0.0))
                elif level > 0:
                    level -= 1
                    i = 2 * i + choose_nearer_half(p[0], i, level + 1)
                    j = 2 * j + choose_nearer_half(p[1], j, level + 1)
                    continue
                else:
                    start = find_foot(shape, p, p[0] + offset.s, p[1] + offset.t)
                    cost += HEIGHT_COST
                    if not is_farther(p, tile, start, best.squared_distance):
                        if not tile.convex:
                            start = find_best_quarter(shape, p, start, i, j)
                            cost += 4 * HEIGHT_COST
                        foot, looks = descend(shape, p, MapPoint(start.s, start.t), MAX_DESCENT)
                        cost += HEIGHT_COST * looks
                        if foot.squared_distance < best.squared_distance:
                            best, looks = descend(shape, p, MapPoint(foot.s, foot.t), NO_DISTANCE)
                            cost += HEIGHT_COST * looks
                            reach = sqrt(best.squared_distance)
        # Next of the four tiles, ordered from the closest one; after the fourth, up one level.
        while level < top:
            near_i, near_j = choose_nearer_half(p[0], i >> 1, level + 1), choose_nearer_half(p[1], j >> 1, level + 1)
            number = ((i & 1) ^ near_i) + 2 * ((j & 1) ^ near_j)
            if number < 3:
                number += 1
                i = (i & ~1) + ((number & 1) ^ near_i)
                j = (j & ~1) + ((number >> 1) ^ near_j)
                break
            level, i, j = level + 1, i >> 1, j >> 1
        if level == top:
            break
    return MapSearch(best, min(unsearched, reach), unsearched >= reach, cost)


@jit
def touch_at(shape: Heightmap, x: Vec3, result: MapSearch) -> TouchedPoint:
    gap, point, normal = compute_gap_at_foot(shape, x, result.foot)
    if not result.is_complete and gap > 0.0 and is_below(shape, x):
        gap, normal = -gap, vec3.scale(-1.0, normal)
    return TouchedPoint(min(gap, result.bound * shape.pitch), point, normal, result.is_complete, result.cost)


@outlined
def find_foot_from(shape: Heightmap, x: Vec3, start: Vec3) -> TouchedPoint:
    """Return the foot point of `x` (3,) m reached by descent from `start` (3,) m, nearest or not."""
    q = to_pitches(shape, start)
    foot, looks = descend(shape, to_pitches(shape, x), MapPoint(q[0], q[1]), NO_DISTANCE)
    return touch_at(shape, x, MapSearch(foot, NO_DISTANCE, True, HEIGHT_COST * looks))


@outlined
def find_nearest_from(shape: Heightmap, x: Vec3, start: Vec3, budget: int) -> TouchedPoint:
    """Return the nearest point; no search is needed if the foot point found from `start` is known to be the nearest."""
    p, q = to_pitches(shape, x), to_pitches(shape, start)
    foot, looks = descend(shape, p, MapPoint(q[0], q[1]), NO_DISTANCE)
    cost = HEIGHT_COST * looks + NEIGHBOUR_COST
    result = MapSearch(foot, NO_DISTANCE, True, cost)
    if not is_convex_around(shape, p, foot):
        result = search(shape, p, foot, budget - cost)
        result = MapSearch(result.foot, result.bound, result.is_complete, result.cost + cost)
    return touch_at(shape, x, result)


@outlined
def compute_gap_within(shape: Heightmap, x: Vec3, reach: float, budget: int) -> Gap:
    """Return the gap of `x` (3,) m, or NO_DISTANCE if it exceeds `reach` (m).

    Without budget, it is the lower bound from the bounding box of the map, -NO_DISTANCE inside of the box.
    """
    p, most = to_pitches(shape, x), reach / shape.pitch * LIMIT_MARGIN
    root = find_tile(shape, p, int(shape.levels) - 1, 0, 0)
    if root.w > 0.0 and compute_squared_distance(root) > most * most:
        return Gap(NO_DISTANCE, True, 1)
    if budget <= 0:
        bound = sqrt(compute_squared_distance(root)) * shape.pitch if root.w > 0.0 else -NO_DISTANCE
        return Gap(bound, False, 1)
    foot, looks = descend(shape, p, MapPoint(p[0], p[1]), NO_DISTANCE)
    cost = HEIGHT_COST * looks + NEIGHBOUR_COST
    result = MapSearch(foot, NO_DISTANCE, True, cost)
    if not is_convex_around(shape, p, foot):
        if foot.squared_distance > most * most and not is_below(shape, x):
            foot = MapFoot(-NO_DISTANCE, -NO_DISTANCE, foot.height, most * most)
        result = search(shape, p, foot, budget - cost)
        result = MapSearch(result.foot, result.bound, result.is_complete, result.cost + cost + HEIGHT_COST)
        if result.foot.s == -NO_DISTANCE:  # no foot point within the limit
            return Gap(
                NO_DISTANCE if result.is_complete else result.bound * shape.pitch, result.is_complete, result.cost
            )
    near = touch_at(shape, x, result)
    return Gap(near.gap, near.is_complete, near.cost)


@outlined
def find_point_above(shape: Heightmap, x: Vec3, radius: float) -> Vec3:
    """Return the point (3,) m above `x` (3,) m at which a fingertip of `radius` (m) is clear of the surface.

    It is above the upper bounds of all tiles within `radius` along the grid.
    """
    p, reach = to_pitches(shape, x), radius / shape.pitch
    top = -NO_DISTANCE
    around = find_tiles_around(shape, p, reach, LIFT_TILES)
    for j in range(around.top, around.bottom + 1):
        for i in range(around.left, around.right + 1):
            tile = find_tile(shape, p, around.level, i, j)
            top = max(top, p[2] - tile.w + tile.rise + tile.thick)
    return x[0], x[1], top * shape.pitch + radius


@jit
def make_consistent(x: Vec3, near: TouchedPoint) -> tuple[float, Vec3, Vec3]:
    """Return consistent gap, point and normal: if the gap is a bound, the point is moved to that distance."""
    if near.is_complete or near.gap < 0.0:
        return near.gap, near.point, near.normal
    _, up = compute_direction(vec3.sub(x, near.point), near.normal)
    return near.gap, vec3.add_scaled(x, -near.gap, up), up


@closest_or_bound.of(Heightmap)
def closest_or_bound_of_heightmap(shape: Heightmap, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    gap, point, normal, remaining = closest_within(shape, x, QUERY_BUDGET)
    return gap, point, normal, 1.0 if remaining < 0 else 0.0


@closest_within.of(Heightmap)
def closest_within_on_heightmap(shape: Heightmap, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    near = find_nearest_from(shape, x, x, max(budget, 0))
    gap, point, normal = make_consistent(x, near)
    return gap, point, normal, compute_remaining_budget(budget, near.is_complete, near.cost)


@outlined
def find_closer_foot_from(shape: Heightmap, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """Return `closest_from`; without budget, for the surface point below `x`."""
    p, q = to_pitches(shape, x), to_pitches(shape, start)
    if budget < 0:
        gap, point, normal = compute_gap_at_foot(shape, x, find_foot(shape, p, p[0], p[1]))
        return gap, point, normal, budget
    foot, looks = descend(shape, p, MapPoint(p[0], p[1]), NO_DISTANCE)
    budget -= HEIGHT_COST * looks + NEIGHBOUR_COST
    if not is_convex_around(shape, p, foot):
        candidate, looks = descend(shape, p, MapPoint(q[0], q[1]), NO_DISTANCE)
        budget -= HEIGHT_COST * looks
        if candidate.squared_distance < EQUAL_SQUARE_SHARE * foot.squared_distance:
            foot = candidate
    gap, point, normal = compute_gap_at_foot(shape, x, foot)
    return gap, point, normal, budget


@closest_from.of(Heightmap)
def closest_from_on_heightmap(shape: Heightmap, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """Return the closer of two foot points, found by descent from below `x` and from `start`.

    `follows` checks at the end of the roll whether there is room for the fingertip.
    """
    return find_closer_foot_from(shape, x, start, budget)


@constraint_at.of(Heightmap)
def constraint_at_support_point(
    shape: Heightmap, center: Vec3, radius: float, normal: Vec3, budget: int
) -> tuple[Vec3, Vec3, int]:
    """Return the foot point found from the previous support point; without budget, `center` - radius `normal`."""
    start = vec3.add_scaled(center, -radius, normal)
    if budget < 0:
        return start, normal, budget
    near = find_foot_from(shape, center, start)
    return near.point, near.normal, budget - near.cost


@nearest_of_shape.of(Heightmap)
def gap_over_heightmap(shape: Heightmap, x: Vec3, within: float, known: Vec3, budget: int) -> NearestObject:
    near = compute_gap_within(shape, x, within, budget)
    return NearestObject(near.gap, 0.0, compute_remaining_budget(budget, near.is_complete, near.cost))
