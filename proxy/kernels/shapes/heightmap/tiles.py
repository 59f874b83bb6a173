"""Tiles of a height map, and what they say of what lies over them without a look at it.

A tile is a square of 2^level cells at a multiple of that, level 0 the cells themselves. What lies over it is within
`thick` of a facet, z = a + b1 (s - s_c) + b2 (t - t_c), measured along z, and bends up and down by no more than
`valley` and `ridge`: the array `facets`, made when the scene is (proxy/heightmaps.py). So nothing of the tile is nearer
to a point than the facet is, less `thick`: of a tile for which that is farther than the best foot nothing is looked at.
A facet is near to what it stands for by the square of the tile's size, so few are. And where the distance is convex,
in four tiles round a foot or in one, there is no other foot.
"""

from math import sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.shapes.heightmap.surface import Foot, Place, gradient, held

LEVELS: Final = 24
"""More than any map has."""
NUMBERS: Final = 6
"""Of a tile: a, b1, b2, thick, valley, ridge."""
AS_NEAR: Final = 1.0 - 4e-13
"""Share of the best square distance at which another one is no nearer, but for rounding."""
FAR: Final = 1e300


@jit
def wide(count: float, level: int) -> int:
    """Tiles of a level in a row of `count` cells."""
    return (int(count) + (1 << level) - 1) >> level


@jit
def beside(place: float, index: int, last: int, count: float) -> float:
    """The coordinate as a tile sees it: one at the border goes on outward, level, so there it is next to the tile."""
    if index == 0 and place < 0.0:
        return 0.0
    if index == last and place > count:
        return count
    return place


@jit
def on_edge(along: float, slope: float, rest: float, half: float) -> tuple[float, float]:
    """The nearest place of an edge, |place| <= half, and the square of the distance but for what is across it.

    along   coordinate of the point along the edge
    slope   of the facet along the edge
    rest    height of the point over the edge's middle
    """
    at = min(max((along + slope * rest) / (1.0 + slope * slope), -half), half)
    d, w = at - along, slope * at - rest
    return at, d * d + w * w


class Tile(NamedTuple):
    """A tile as a point p sees it, in pitches.

    half                   of its width
    middle_s, middle_t     its middle
    u, v, w                p less that and less the facet's height there
    b1, b2, thick, rise    of its facet; how far it rises from its middle
    convex                 whether the distance to p is convex over it
    """

    half: float
    middle_s: float
    middle_t: float
    u: float
    v: float
    w: float
    b1: float
    b2: float
    thick: float
    rise: float
    convex: bool


@jit
def tile_at(shape: Heightmap, p: Vec3, level: int, i: int, j: int) -> Tile:
    across, down = wide(shape.columns, level), wide(shape.rows, level)
    at = (int(shape.starts[level]) + j * across + i) * NUMBERS
    b1, b2, thick = shape.facets[at + 1], shape.facets[at + 2], shape.facets[at + 3]
    half = 0.5 * (1 << level)
    middle_s, middle_t = (2.0 * i + 1.0) * half, (2.0 * j + 1.0) * half
    u = beside(p[0], i, across - 1, shape.columns) - middle_s
    v = beside(p[1], j, down - 1, shape.rows) - middle_t
    w = p[2] - shape.facets[at]
    rise = (abs(b1) + abs(b2)) * half
    convex = (w + rise + thick) * shape.facets[at + 4] < 1.0 and (rise + thick - w) * shape.facets[at + 5] < 1.0
    return Tile(
        half=half, middle_s=middle_s, middle_t=middle_t, u=u, v=v, w=w, b1=b1, b2=b2, thick=thick, rise=rise,
        convex=convex,
    )  # fmt: skip


@jit
def square_to_box(tile: Tile) -> float:
    """Square of the distance from the point to the box round what lies over the tile."""
    u, v = max(abs(tile.u) - tile.half, 0.0), max(abs(tile.v) - tile.half, 0.0)
    w = max(abs(tile.w) - tile.rise - tile.thick, 0.0)
    return u * u + v * v + w * w


@jit
def to_facet(tile: Tile) -> tuple[float, Place]:
    """Square of the distance to the facet, and where its nearest place is from the point."""
    b1, b2, half = tile.b1, tile.b2, tile.half
    steep = 1.0 + b1 * b1 + b2 * b2
    over = (tile.w - b1 * tile.u - b2 * tile.v) / steep
    s, t = tile.u + b1 * over, tile.v + b2 * over
    square = over * over * steep
    out_s, out_t = abs(s) > half, abs(t) > half
    if out_s or out_t:
        # The nearest place lies on an edge beyond which the foot on the facet's plane is.
        edge_s, edge_t = half if s > 0.0 else -half, half if t > 0.0 else -half
        square = FAR
        if out_s:
            at, square = on_edge(tile.v, b2, tile.w - b1 * edge_s, half)
            square += (edge_s - tile.u) * (edge_s - tile.u)
            s, t = edge_s, at
        if out_t:
            at, other = on_edge(tile.u, b1, tile.w - b2 * edge_t, half)
            other += (edge_t - tile.v) * (edge_t - tile.v)
            if other < square:
                square, s, t = other, at, edge_t
    return square, Place(s - tile.u, t - tile.v)


@jit
def place_of(place: float, level: int, count: float) -> int:
    """The tile in a row of them that has the coordinate, or is next to it."""
    return min(int(held(place, count)) >> level, wide(count, level) - 1)


class Around(NamedTuple):
    """Tiles of a level, from `left` to `right` and from `top` to `bottom`."""

    level: int
    left: int
    right: int
    top: int
    bottom: int


@jit
def tiles_around(shape: Heightmap, p: Vec3, reach: float, side: int) -> Around:
    """The tiles in which all is that lies within `reach`, in pitches, along the grid: `side` + 1 a side at most."""
    level, top = 0, int(shape.levels) - 1
    while level < top and side * (1 << level) < 2.0 * reach:
        level += 1
    return Around(
        level=level,
        left=place_of(p[0] - reach, level, shape.columns),
        right=place_of(p[0] + reach, level, shape.columns),
        top=place_of(p[1] - reach, level, shape.rows),
        bottom=place_of(p[1] + reach, level, shape.rows),
    )


@jit
def convex_around(shape: Heightmap, p: Vec3, foot: Foot) -> bool:
    """Whether the distance is convex wherever something may be nearer than the foot: then it is the nearest point."""
    around = tiles_around(shape, p, sqrt(foot.square), 1)
    for j in range(around.top, around.bottom + 1):
        for i in range(around.left, around.right + 1):
            if not tile_at(shape, p, around.level, i, j).convex:
                return False
    return True


@jit
def has(tile: Tile, foot: Foot) -> bool:
    return abs(foot.s - tile.middle_s) <= tile.half and abs(foot.t - tile.middle_t) <= tile.half


@jit
def nearer_half(place: float, index: int, level: int) -> int:
    """Which of the two halves of a tile a coordinate is nearer to, 0 or 1."""
    return 1 if place > (2.0 * index + 1.0) * 0.5 * (1 << level) else 0


@jit
def least_along(slope: float, place: float, half: float) -> float:
    """What a linear function falls by at the most on its way from `place` to anywhere within |place| <= half."""
    return slope * ((-half if slope > 0.0 else half) - place)


@jit
def beaten(p: Vec3, tile: Tile, place: Foot, square: float) -> bool:
    """Whether nothing of the tile is nearer than that: a convex function stays above its tangent plane."""
    if not (tile.convex and has(tile, place)):
        return False
    gs, gt = gradient(p, place)
    falls = least_along(gs, place.s - tile.middle_s, tile.half) + least_along(gt, place.t - tile.middle_t, tile.half)
    return place.square + 2.0 * falls >= AS_NEAR * square
