"""Conversion of a height map to the arrays of its kernels: coefficients of the spline, and tiles for the search.

The spline passes through every height: of three adjacent coefficients (c_-1 + 4 c_0 + c_1) / 6 is the height. At
the rim its curvature is zero (natural spline), so that c_-1 = 2 c_0 - c_1 beyond it. Farther out the coefficients
repeat the ones next to the rim, and the surface is level from the third pixel on.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from softfinger.config import limits, schema
from softfinger.config.arrays.grids import Grid, read_grid
from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.shapes import heightmap  # noqa: F401 - its kernels

RIM_COEFFICIENTS: Final = 4
"""Coefficients beyond each side of the map: one for zero curvature at the rim, and three copies of it."""
THICKNESS_MARGIN: Final = 1e-13
"""Increase of a tile's thickness for rounding, relative to the largest coefficient of the map."""


class Facets(NamedTuple):
    """Planes that approximate tiles, with bounds; (rows, columns) each.

    a       height in the middle
    b1, b2  slopes along columns and rows
    thick   bound of the distance between surface and plane, along z
    valley  bound of the largest eigenvalue of h'': upward curvature
    ridge   bound of the largest eigenvalue of -h'': downward curvature
    """

    a: Grid
    b1: Grid
    b2: Grid
    thick: Grid
    valley: Grid
    ridge: Grid


def read_heights(obj: schema.Heightmap) -> Grid:
    """Return the heights (rows, columns), m, from the object's file. Raises ConfigError if it cannot be used."""
    try:
        heights = _count_levels(obj) * obj.level_m
        most, worst = limits.COORDINATE_M.high, float(heights.flat[np.abs(heights).argmax()])
        if abs(worst) > most:
            raise ConfigError(
                f"{obj.file}: a height of {worst:g} m with level_m = {obj.level_m:g}, at most {most:g} m up or "
                "down is allowed: reduce level_m"
            )
    except ConfigError as error:
        raise ConfigError(f"object '{obj.name}': file: {error}") from error
    return heights


def _count_levels(obj: schema.Heightmap) -> Grid:
    if obj.hfield is None:
        return read_grid(obj.file, even=True)
    from softfinger.config.mjcf import read_hfield  # requires MuJoCo

    return read_hfield(obj.file, obj.root, obj.hfield)


def compile_heightmap(heights: Grid, pitch: float) -> model.Heightmap:
    """Return the map of heights (rows, columns), m, `pitch` m apart, columns along x and rows along y."""
    spline = fit_spline(heights / pitch)
    facets = [make_cell_facets(spline)]
    while facets[-1].a.size > 1:
        facets.append(merge_facets(facets[-1], 2.0 ** (len(facets) - 1)))
    slack = THICKNESS_MARGIN * float(np.abs(spline).max())
    tiles = [np.stack(level._replace(thick=level.thick + slack), axis=-1).reshape(-1, len(level)) for level in facets]
    rows, columns = facets[0].a.shape
    return model.Heightmap(
        pitch=pitch,
        columns=float(columns),
        rows=float(rows),
        levels=float(len(facets)),
        coefficients=ReadOnly(spline),
        facets=ReadOnly(np.concatenate(tiles)),
        starts=ReadOnly(np.cumsum([0, *map(len, tiles)])),
    )


def bound_curvature(heights: Grid, pitch: float) -> float:
    """Return an upper bound of the upward curvature of the map within its pixels, 1/m."""
    valley, _ = bound_bends(fit_spline(heights / pitch))
    first, (rows, columns) = RIM_COEFFICIENTS - 1, heights.shape
    return float(valley[first : first + max(rows - 1, 1), first : first + max(columns - 1, 1)].max()) / pitch


def measure_overshoot(heights: Grid) -> float:
    """Return by how much the surface rises above or falls below the four pixels around it, m, at fifths of a cell."""
    rows, columns = heights.shape
    if min(rows, columns) < 2:
        heights = np.repeat(np.repeat(heights, 1 + (rows < 2), 0), 1 + (columns < 2), 1)
        rows, columns = heights.shape
    first = RIM_COEFFICIENTS - 1
    net = _compute_bezier_net(fit_spline(heights)[first : first + rows + 2, first : first + columns + 2])
    corners = [heights[j : rows - 1 + j, i : columns - 1 + i] for j in (0, 1) for i in (0, 1)]
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    weights = [
        np.array([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3]) for t in (0.0, 0.2, 0.4, 0.6, 0.8)
    ]
    most = 0.0
    for along in weights:
        for across in weights:
            surface = sum(along[j] * across[i] * net[j][i] for j in range(4) for i in range(4))
            most = max(most, float((surface - high).max()), float((low - surface).max()))
    return most


def thin_map(heights: Grid, pitch: float, most: int) -> tuple[Grid, Grid, Grid]:
    """Reduce a map to at most `most` pixels a side.

    Returns x (columns,) and y (rows,), m, and heights (rows, columns).
    """
    rows, columns = (np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int)) for n in heights.shape)
    x, y = ((indices - 0.5 * (n - 1)) * pitch for indices, n in ((columns, heights.shape[1]), (rows, heights.shape[0])))
    return x, y, heights[np.ix_(rows, columns)]


def fit_spline(values: Grid) -> Grid:
    """Return the coefficients of the spline through values (rows, columns), RIM_COEFFICIENTS more on each side."""
    return _fit_along_rows(_fit_along_rows(values).T).T


def _fit_along_rows(values: Grid) -> Grid:
    """Fit a spline along the first axis, for each column: Thomas' algorithm for (1, 4, 1) of the inner rows."""
    count = len(values)
    result = values.copy()
    if count > 2:
        right, share = 6.0 * values[1:-1], np.empty(count - 2)
        right[0] -= values[0]
        right[-1] -= values[-1]
        share[0] = 0.25
        right[0] *= 0.25
        for k in range(1, count - 2):
            share[k] = 1.0 / (4.0 - share[k - 1])
            right[k] = (right[k] - right[k - 1]) * share[k]
        for k in range(count - 4, -1, -1):
            right[k] -= share[k] * right[k + 1]
        result[1:-1] = right
    inner = result[[1, -2]] if count > 1 else result[[0, 0]]
    before, behind = 2.0 * result[0] - inner[0], 2.0 * result[-1] - inner[1]
    return np.concatenate(
        [np.repeat(before[None], RIM_COEFFICIENTS, 0), result, np.repeat(behind[None], RIM_COEFFICIENTS, 0)]
    )


def make_cell_facets(spline: Grid) -> Facets:
    """Return the facets of the cells.

    The surface of a cell is between the 16 heights of its Bezier net. The net of a plane is coplanar, so it has zero
    thickness.
    """
    net = _compute_bezier_net(spline)
    b1 = 0.5 * (net[0][3] - net[0][0] + net[3][3] - net[3][0])
    b2 = 0.5 * (net[3][0] - net[0][0] + net[3][3] - net[0][3])
    off = [net[j][i] - (i / 3.0 - 0.5) * b1 - (j / 3.0 - 0.5) * b2 for j in range(4) for i in range(4)]
    low, high = np.minimum.reduce(off), np.maximum.reduce(off)
    return Facets(0.5 * (low + high), b1, b2, 0.5 * (high - low), *bound_bends(spline))


def _compute_bezier_net(spline: Grid) -> list[list[Grid]]:
    """Return the heights of the Bezier net of every cell: [j][i] along rows and columns, (rows, columns) each."""

    def split(c: Grid) -> list[Grid]:
        """Split along the first axis."""
        c0, c1, c2, c3 = (c[k : len(c) - 3 + k] for k in range(4))
        return [(c0 + 4.0 * c1 + c2) / 6.0, (2.0 * c1 + c2) / 3.0, (c1 + 2.0 * c2) / 3.0, (c1 + 4.0 * c2 + c3) / 6.0]

    return [[patch.T for patch in split(row.T)] for row in split(spline)]


def merge_facets(small: Facets, size: float) -> Facets:
    """Return the facets of the tiles that combine four tiles of `size` cells, fewer at the rim.

    A tile has the mean slope of its parts, and a thickness that includes theirs.
    """
    pads = [(0, small.a.shape[0] % 2), (0, small.a.shape[1] % 2)]
    padded = [np.pad(part, pads, mode="edge") for part in small]
    a, b1, b2, thick, *bending = ([part[j::2, i::2] for j in (0, 1) for i in (0, 1)] for part in padded)
    bends = [np.maximum.reduce(part) for part in bending]
    # Missing parts at the rim are masked, as if the tile were smaller.
    rows, columns = np.indices(a[0].shape)
    present = [(2 * rows + j < small.a.shape[0]) & (2 * columns + i < small.a.shape[1]) for j in (0, 1) for i in (0, 1)]
    count = sum(mask.astype(float) for mask in present)
    slope1, slope2 = (sum(mask * part for mask, part in zip(present, of, strict=True)) / count for of in (b1, b2))
    lows, highs = [], []
    for k, mask in enumerate(present):
        u, v = (k % 2 - 0.5) * size, (k // 2 - 0.5) * size
        off = a[k] - slope1 * u - slope2 * v
        spread = thick[k] + 0.5 * size * (np.abs(b1[k] - slope1) + np.abs(b2[k] - slope2))
        lows.append(np.where(mask, off - spread, np.inf))
        highs.append(np.where(mask, off + spread, -np.inf))
    low, high = np.minimum.reduce(lows), np.maximum.reduce(highs)
    return Facets(0.5 * (low + high), slope1, slope2, 0.5 * (high - low), *bends)


def bound_bends(spline: Grid) -> tuple[Grid, Grid]:
    """Return upper bounds of the largest eigenvalues of h'' and of -h'' in each cell, not negative.

    Derivatives of a B-spline are B-splines of differences of its coefficients, and in a cell between the differences
    there.
    """
    ss, tt = np.diff(spline, 2, axis=1), np.diff(spline, 2, axis=0)
    mixed = _find_block_maxima(np.abs(np.diff(np.diff(spline, axis=0), axis=1)), 3, 3)
    up = np.maximum(_find_block_maxima(ss, 4, 2), _find_block_maxima(tt, 2, 4)) + mixed
    down = np.maximum(_find_block_maxima(-ss, 4, 2), _find_block_maxima(-tt, 2, 4)) + mixed
    return np.maximum(up, 0.0), np.maximum(down, 0.0)


def _find_block_maxima(values: Grid, rows: int, columns: int) -> Grid:
    """Return the maximum of every block of rows x columns."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(values, (rows, columns)).max(axis=(2, 3)))
