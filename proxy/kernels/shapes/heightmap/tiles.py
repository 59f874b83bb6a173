"""Tiles of a height map: bounds of the surface over them, without its evaluation.

A tile is a square of 2^level cells a side, aligned to a multiple of its size; tiles of level 0 are the cells. The
surface over it is within `thick` of a facet, z = a + b1 (s - s_c) + b2 (t - t_c), measured along z, and its second
derivatives up and down are at most `valley` and `ridge`. The array `facets` stores these numbers, computed with the
scene (proxy/heightmaps.py). So no point of the tile is closer to p than the distance to the facet less `thick`, and a
search skips tiles for which this exceeds the distance of the best foot point. Few tiles remain, because `thick`
decreases with the square of the tile's size. Where the distance is convex, over one tile or four round a foot point,
there is no second foot point.
"""

from math import sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.shapes.heightmap.surface import MapFoot, MapPoint, clamp_to_cells, compute_gradient

MAX_LEVELS: Final = 24
"""Upper bound of the number of levels of any map."""
TILE_SIZE: Final = 6
"""Entries of `facets` per tile: a, b1, b2, thick, valley, ridge."""
EQUAL_SQUARE_SHARE: Final = 1.0 - 4e-13
"""Share of the best squared distance above which another one counts as equal, because of rounding."""
NO_DISTANCE: Final = 1e300


@jit
def count_tiles(count: float, level: int) -> int:
    """Return the number of tiles of a level in a row of `count` cells."""
    return (int(count) + (1 << level) - 1) >> level


@jit
def compute_tile_coordinate(place: float, index: int, last: int, count: float) -> float:
    """Return a coordinate as used for the tile at `index`: a tile at the border extends outward at constant height.

    So a coordinate beyond the map becomes that of the border.
    """
    if index == 0 and place < 0.0:
        return 0.0
    if index == last and place > count:
        return count
    return place


@jit
def find_nearest_on_edge(along: float, slope: float, height: float, half: float) -> tuple[float, float]:
    """Return the nearest position on an edge, within +-half, and the squared distance without the part across the edge.

    along   coordinate of the point along the edge
    slope   of the facet along the edge
    height  of the point above the edge's middle
    """
    nearest = min(max((along + slope * height) / (1.0 + slope * slope), -half), half)
    d, w = nearest - along, slope * nearest - height
    return nearest, d * d + w * w


class Tile(NamedTuple):
    """Tile relative to a point p, in pitches.

    half                   half of its width
    middle_s, middle_t     its middle
    u, v, w                p relative to the middle of its facet
    b1, b2, thick          of its facet
    rise                   largest height of the facet above its middle
    convex                 True if the distance to p is convex over the tile
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
def find_tile(shape: Heightmap, p: Vec3, level: int, i: int, j: int) -> Tile:
    across, down = count_tiles(shape.columns, level), count_tiles(shape.rows, level)
    first = (int(shape.starts[level]) + j * across + i) * TILE_SIZE
    b1, b2, thick = shape.facets[first + 1], shape.facets[first + 2], shape.facets[first + 3]
    half = 0.5 * (1 << level)
    middle_s, middle_t = (2.0 * i + 1.0) * half, (2.0 * j + 1.0) * half
    u = compute_tile_coordinate(p[0], i, across - 1, shape.columns) - middle_s
    v = compute_tile_coordinate(p[1], j, down - 1, shape.rows) - middle_t
    w = p[2] - shape.facets[first]
    rise = (abs(b1) + abs(b2)) * half
    convex = (w + rise + thick) * shape.facets[first + 4] < 1.0 and (rise + thick - w) * shape.facets[first + 5] < 1.0
    return Tile(
        half=half, middle_s=middle_s, middle_t=middle_t, u=u, v=v, w=w, b1=b1, b2=b2, thick=thick, rise=rise,
        convex=convex,
    )  # fmt: skip


@jit
def compute_squared_distance(tile: Tile) -> float:
    """Return the squared distance from the point to the box round the surface over the tile."""
    u, v = max(abs(tile.u) - tile.half, 0.0), max(abs(tile.v) - tile.half, 0.0)
    w = max(abs(tile.w) - tile.rise - tile.thick, 0.0)
    return u * u + v * v + w * w


@jit
def to_facet(tile: Tile) -> tuple[float, MapPoint]:
    """Return the squared distance from the point to the facet, and the nearest position relative to the point."""
    b1, b2, half = tile.b1, tile.b2, tile.half
    steep = 1.0 + b1 * b1 + b2 * b2
    over = (tile.w - b1 * tile.u - b2 * tile.v) / steep
    s, t = tile.u + b1 * over, tile.v + b2 * over
    square = over * over * steep
    out_s, out_t = abs(s) > half, abs(t) > half
    if out_s or out_t:
        # The projection to the facet's plane is beyond one or two edges; the nearest point is on one of them.
        edge_s, edge_t = half if s > 0.0 else -half, half if t > 0.0 else -half
        square = NO_DISTANCE
        if out_s:
            at, square = find_nearest_on_edge(tile.v, b2, tile.w - b1 * edge_s, half)
            square += (edge_s - tile.u) * (edge_s - tile.u)
            s, t = edge_s, at
        if out_t:
            at, square_t = find_nearest_on_edge(tile.u, b1, tile.w - b2 * edge_t, half)
            square_t += (edge_t - tile.v) * (edge_t - tile.v)
            if square_t < square:
                square, s, t = square_t, at, edge_t
    return square, MapPoint(s - tile.u, t - tile.v)


@jit
def find_place(place: float, level: int, count: float) -> int:
    """Return the index, in its row of tiles, of the tile that contains the coordinate or is closest to it."""
    return min(int(clamp_to_cells(place, count)) >> level, count_tiles(count, level) - 1)


class NeighbourTiles(NamedTuple):
    """Tiles of a level from `left` to `right` and from `top` to `bottom`, inclusive."""

    level: int
    left: int
    right: int
    top: int
    bottom: int


@jit
def find_tiles_around(shape: Heightmap, p: Vec3, reach: float, side: int) -> NeighbourTiles:
    """Return the tiles that cover everything within `reach` (pitches) along the grid: at most `side` + 1 per side."""
    level, top = 0, int(shape.levels) - 1
    while level < top and side * (1 << level) < 2.0 * reach:
        level += 1
    return NeighbourTiles(
        level=level,
        left=find_place(p[0] - reach, level, shape.columns),
        right=find_place(p[0] + reach, level, shape.columns),
        top=find_place(p[1] - reach, level, shape.rows),
        bottom=find_place(p[1] + reach, level, shape.rows),
    )


@jit
def is_convex_around(shape: Heightmap, p: Vec3, foot: MapFoot) -> bool:
    """Return True if the distance is convex over all tiles that may be closer than the foot point.

    The foot point is then the nearest point.
    """
    around = find_tiles_around(shape, p, sqrt(foot.squared_distance), 1)
    for j in range(around.top, around.bottom + 1):
        for i in range(around.left, around.right + 1):
            if not find_tile(shape, p, around.level, i, j).convex:
                return False
    return True


@jit
def contains_foot(tile: Tile, foot: MapFoot) -> bool:
    return abs(foot.s - tile.middle_s) <= tile.half and abs(foot.t - tile.middle_t) <= tile.half


@jit
def choose_nearer_half(place: float, index: int, level: int) -> int:
    """Return the half of a tile, 0 or 1, that is closer to a coordinate."""
    return 1 if place > (2.0 * index + 1.0) * 0.5 * (1 << level) else 0


@jit
def find_least_along(slope: float, place: float, half: float) -> float:
    """Return the smallest change of a linear function from `place` to any position within +-half."""
    return slope * ((-half if slope > 0.0 else half) - place)


@jit
def is_farther(p: Vec3, tile: Tile, place: MapFoot, square: float) -> bool:
    """Return True if no point of the tile is closer than the squared distance `square`.

    A convex function is nowhere below its tangent plane, here that at `place`.
    """
    if not (tile.convex and contains_foot(tile, place)):
        return False
    gs, gt = compute_gradient(p, place)
    falls = find_least_along(gs, place.s - tile.middle_s, tile.half) + find_least_along(
        gt, place.t - tile.middle_t, tile.half
    )
    return place.squared_distance + 2.0 * falls >= EQUAL_SQUARE_SHARE * square
