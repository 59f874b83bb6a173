"""The nearest point of a height map, and how far it is to anything, within a budget.

Tiles (`tiles`) are visited depth first, of four the nearer ones first, without a stack: where a tile is says what comes
next. Those that cannot have the nearest point are left out, and in the cells that remain Newton's method runs.

What is asked is counted, 1 for a tile and LOOK for a height; that costs about what a node of a mesh does. Where the
budget is used up the answer is the best foot so far, and a bound: the least that any tile that was left may be away.
The surface is then taken to be that near, towards the best foot. So a fingertip is held a little too early, never late,
and what it is put on is outside.
"""

from math import sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.composite import Deepest, nearest_of_shape
from softfinger.proxy.kernels.shapes.heightmap.surface import (
    Foot,
    Place,
    descend,
    foot_at,
    in_pitches,
    is_below,
    touching,
)
from softfinger.proxy.kernels.shapes.heightmap.tiles import (
    AS_NEAR,
    FAR,
    LEVELS,
    beaten,
    convex_around,
    has,
    nearer_half,
    square_to_box,
    tile_at,
    tiles_around,
    to_facet,
    wide,
)
from softfinger.proxy.kernels.shapes.protocol import (
    closest_from,
    closest_or_bound,
    closest_within,
    constraint_at,
    direction,
)

LOOK: Final = 2
"""What a height costs, in tiles; of those one takes some 10 ns."""
AROUND: Final = 4
"""What a look at the tiles round a foot costs."""
BUDGET: Final = 700
"""Of a question for the nearest point."""
UNDER: Final = 8
"""Tiles a side, and one more, by which a fingertip is lifted over what is under it."""
ASTRAY: Final = 2.0
"""Cells that the way from a cell to its foot may lead; farther on another cell finds it."""
SPENT: Final = -1
"""What is left of a budget that was used up."""
ABOVE: Final = 1.0 + 1e-9
"""By what a limit is passed over, so that rounding does not leave out what is at it."""


class Found(NamedTuple):
    """The nearest foot of a point, or the nearest that is known.

    bound   nothing is nearer, in pitches
    whole   whether the budget was enough
    spent   what was asked for it
    """

    foot: Foot
    bound: float
    whole: bool
    spent: int


class Touched(NamedTuple):
    """Gap, point and normal as of `closest`; where the budget was not enough the gap is a bound, and the point the
    nearest that is known. `spent` is what was asked."""

    gap: float
    point: Vec3
    normal: Vec3
    whole: bool
    spent: int


class Gap(NamedTuple):
    """A gap (m), or what it is not below where the budget was not enough, and what was asked for it."""

    gap: float
    whole: bool
    spent: int


@jit
def left_of(budget: int, whole: bool, spent: int) -> int:
    """What is left of a budget after a question, below 0 where it was used up, then or before."""
    return SPENT if budget < 0 or not whole else max(budget - spent, 0)


@jit
def best_of_quarters(shape: Heightmap, p: Vec3, start: Foot, i: int, j: int) -> Foot:
    """The nearest of a place and the middles of a cell's quarters: from there the cell's best foot is downhill."""
    for number in range(4):
        other = foot_at(shape, p, i + 0.25 + 0.5 * (number & 1), j + 0.25 + 0.5 * (number >> 1))
        if other.square < start.square:
            start = other
    return start


@outlined
def search(shape: Heightmap, p: Vec3, best: Foot, budget: int) -> Found:
    """The nearest foot, `best` if there is no nearer one; the bound is not above its distance."""
    top = int(shape.levels) - 1
    level, i, j = top, 0, 0
    spent, left, reach = 0, FAR, sqrt(best.square)
    for _ in range(max(budget, 0) + 4 * LEVELS):
        spent += 1
        if i < wide(shape.columns, level) and j < wide(shape.rows, level):
            tile = tile_at(shape, p, level, i, j)
            square, way = square_to_box(tile), Place(0.0, 0.0)
            asks = square < AS_NEAR * best.square and not (tile.convex and has(tile, best))
            if asks:
                square, way = to_facet(tile)
            if asks and square < (reach + tile.thick) * (reach + tile.thick) * AS_NEAR:
                if spent >= budget:
                    left = min(left, max(sqrt(square) - tile.thick, 0.0))
                elif level > 0:
                    level -= 1
                    i = 2 * i + nearer_half(p[0], i, level + 1)
                    j = 2 * j + nearer_half(p[1], j, level + 1)
                    continue
                else:
                    start = foot_at(shape, p, p[0] + way.s, p[1] + way.t)
                    spent += LOOK
                    if not beaten(p, tile, start, best.square):
                        if not tile.convex:
                            start = best_of_quarters(shape, p, start, i, j)
                            spent += 4 * LOOK
                        foot, looks = descend(shape, p, Place(start.s, start.t), ASTRAY)
                        spent += LOOK * looks
                        if foot.square < best.square:
                            best, looks = descend(shape, p, Place(foot.s, foot.t), FAR)
                            spent += LOOK * looks
                            reach = sqrt(best.square)
        # On to the next of four, in their order from the nearer one; behind the fourth up.
        while level < top:
            near_i, near_j = nearer_half(p[0], i >> 1, level + 1), nearer_half(p[1], j >> 1, level + 1)
            number = ((i & 1) ^ near_i) + 2 * ((j & 1) ^ near_j)
            if number < 3:
                number += 1
                i = (i & ~1) + ((number & 1) ^ near_i)
                j = (j & ~1) + ((number >> 1) ^ near_j)
                break
            level, i, j = level + 1, i >> 1, j >> 1
        if level == top:
            break
    return Found(best, min(left, reach), left >= reach, spent)


@jit
def touched(shape: Heightmap, x: Vec3, found: Found) -> Touched:
    gap, point, normal = touching(shape, x, found.foot)
    if not found.whole and gap > 0.0 and is_below(shape, x):
        gap, normal = -gap, vec3.scale(-1.0, normal)
    return Touched(min(gap, found.bound * shape.pitch), point, normal, found.whole, found.spent)


@outlined
def downhill(shape: Heightmap, x: Vec3, start: Vec3) -> Touched:
    """The foot of `x` (3,) m that is downhill from `start` (3,) m, whatever is nearer elsewhere."""
    at = in_pitches(shape, start)
    foot, looks = descend(shape, in_pitches(shape, x), Place(at[0], at[1]), FAR)
    return touched(shape, x, Found(foot, FAR, True, LOOK * looks))


@outlined
def nearest_from(shape: Heightmap, x: Vec3, start: Vec3, budget: int) -> Touched:
    """The nearest of all, sooner where the foot that is downhill from `start` is as near as any."""
    p, at = in_pitches(shape, x), in_pitches(shape, start)
    foot, looks = descend(shape, p, Place(at[0], at[1]), FAR)
    spent = LOOK * looks + AROUND
    found = Found(foot, FAR, True, spent)
    if not convex_around(shape, p, foot):
        found = search(shape, p, foot, budget - spent)
        found = Found(found.foot, found.bound, found.whole, found.spent + spent)
    return touched(shape, x, found)


@outlined
def gap_within(shape: Heightmap, x: Vec3, reach: float, budget: int) -> Gap:
    """Of `x` (3,) m; FAR if it is above `reach`, m. Without budget no more is known than that of the box round all."""
    p, most = in_pitches(shape, x), reach / shape.pitch * ABOVE
    whole = tile_at(shape, p, int(shape.levels) - 1, 0, 0)
    if whole.w > 0.0 and square_to_box(whole) > most * most:
        return Gap(FAR, True, 1)
    if budget <= 0:
        return Gap(sqrt(square_to_box(whole)) * shape.pitch if whole.w > 0.0 else -FAR, False, 1)
    foot, looks = descend(shape, p, Place(p[0], p[1]), FAR)
    spent = LOOK * looks + AROUND
    found = Found(foot, FAR, True, spent)
    if not convex_around(shape, p, foot):
        if foot.square > most * most and not is_below(shape, x):
            foot = Foot(-FAR, -FAR, foot.height, most * most)
        found = search(shape, p, foot, budget - spent)
        found = Found(found.foot, found.bound, found.whole, found.spent + spent + LOOK)
        if found.foot.s == -FAR:  # no foot is as near
            return Gap(FAR if found.whole else found.bound * shape.pitch, found.whole, found.spent)
    near = touched(shape, x, found)
    return Gap(near.gap, near.whole, near.spent)


@outlined
def above(shape: Heightmap, x: Vec3, radius: float) -> Vec3:
    """Over `x` (3,) m where nothing that lies within `radius`, m, along the grid can reach a fingertip of that."""
    p, reach = in_pitches(shape, x), radius / shape.pitch
    top = -FAR
    around = tiles_around(shape, p, reach, UNDER)
    for j in range(around.top, around.bottom + 1):
        for i in range(around.left, around.right + 1):
            tile = tile_at(shape, p, around.level, i, j)
            top = max(top, p[2] - tile.w + tile.rise + tile.thick)
    return x[0], x[1], top * shape.pitch + radius


@jit
def as_asked(x: Vec3, near: Touched) -> tuple[float, Vec3, Vec3]:
    """Gap, point and normal that belong together: where the gap is a bound the point is that far away."""
    if near.whole or near.gap < 0.0:
        return near.gap, near.point, near.normal
    _, up = direction(vec3.sub(x, near.point), near.normal)
    return near.gap, vec3.add_scaled(x, -near.gap, up), up


@closest_or_bound.of(Heightmap)
def closest_known_on_heightmap(shape: Heightmap, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    gap, point, normal, left = closest_within(shape, x, BUDGET)
    return gap, point, normal, 1.0 if left < 0 else 0.0


@closest_within.of(Heightmap)
def closest_within_on_heightmap(shape: Heightmap, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    near = nearest_from(shape, x, x, max(budget, 0))
    gap, point, normal = as_asked(x, near)
    return gap, point, normal, left_of(budget, near.whole, near.spent)


@outlined
def downhill_from_two(shape: Heightmap, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """`closest_from`; without budget of the place below `x` alone."""
    p, at = in_pitches(shape, x), in_pitches(shape, start)
    if budget < 0:
        gap, point, normal = touching(shape, x, foot_at(shape, p, p[0], p[1]))
        return gap, point, normal, budget
    foot, looks = descend(shape, p, Place(p[0], p[1]), FAR)
    budget -= LOOK * looks + AROUND
    if not convex_around(shape, p, foot):
        other, looks = descend(shape, p, Place(at[0], at[1]), FAR)
        budget -= LOOK * looks
        if other.square < AS_NEAR * foot.square:
            foot = other
    gap, point, normal = touching(shape, x, foot)
    return gap, point, normal, budget


@closest_from.of(Heightmap)
def closest_from_on_heightmap(shape: Heightmap, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """Of the feet that are downhill from below `x` and from `start` the nearer: whether there is room is asked where
    the roll ends (`follows`)."""
    return downhill_from_two(shape, x, start, budget)


@constraint_at.of(Heightmap)
def constraint_at_support_point(
    shape: Heightmap, center: Vec3, radius: float, normal: Vec3, budget: int
) -> tuple[Vec3, Vec3, int]:
    """The foot that is downhill from where it was. Without budget the tangent plane in which the fingertip lies."""
    start = vec3.add_scaled(center, -radius, normal)
    if budget < 0:
        return start, normal, budget
    near = downhill(shape, center, start)
    return near.point, near.normal, budget - near.spent


@nearest_of_shape.of(Heightmap)
def gap_over_heightmap(shape: Heightmap, x: Vec3, within: float, known: Vec3, budget: int) -> Deepest:
    near = gap_within(shape, x, within, budget)
    return Deepest(near.gap, 0.0, left_of(budget, near.whole, near.spent))
