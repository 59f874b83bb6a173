"""Triangles of objects defined by a file, few enough to draw and to send."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays.grids import Grid
from softfinger.proxy.heightmaps import read_heights, thin_map
from softfinger.proxy.meshes.prepared import load_latest_picture
from softfinger.proxy.meshes.reading import Arrays

MAP_PIXELS: Final = 158
"""Largest number of pixels of a height map's picture along each side: 49 298 triangles, as many as of a mesh."""

Filed = schema.Mesh | schema.Heightmap
"""Objects with their geometry in a separate file."""


class Picture(NamedTuple):
    """Triangles in the object's frame, m, counter-clockwise seen from outside; `of` is the number before reduction."""

    arrays: Arrays
    of: int


def make_picture(obj: Filed) -> Picture:
    """Return the picture of an object. Raises ConfigError, with its name, if its file cannot be used any more."""
    if isinstance(obj, schema.Mesh):
        report, arrays = load_latest_picture(obj)
        return Picture(arrays, report.triangles)
    heights = read_heights(obj)
    rows, columns = (max(count - 1, 1) for count in heights.shape)
    return Picture(make_relief(*thin_map(heights, obj.pitch_m, MAP_PIXELS)), 2 * rows * columns)


def make_relief(x: Grid, y: Grid, z: Grid) -> Arrays:
    """Return two triangles for each cell between heights `z` (rows, columns) at x (columns,) and y (rows,).

    A map of one row or one column, an infinite profile, is drawn as deep as it is wide. They face upwards. Lengths in
    m.
    """
    if len(y) == 1:
        y, z = x[[0, -1]], z[[0, 0]]
    elif len(x) == 1:
        x, z = y[[0, -1]], z[:, [0, 0]]
    at_x, at_y = np.meshgrid(x, y)
    number = np.arange(z.size, dtype=np.int32).reshape(z.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Arrays(np.column_stack([at_x.ravel(), at_y.ravel(), z.ravel()]), triangles)
