"""Objects that are made of a file as triangles, few enough for a picture and for the wire."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays.grids import Grid
from softfinger.proxy.heightmaps import read_heights, thinned
from softfinger.proxy.meshes.prepared import rendered
from softfinger.proxy.meshes.reading import Arrays

MAP_PIXELS: Final = 158
"""Of a height map along each side, at most: 49 298 triangles, as many as of a mesh."""

Filed = schema.Mesh | schema.Heightmap
"""What of an object is to be seen is in no table of these, but in a file."""


class Picture(NamedTuple):
    """Triangles in the object's frame, m, counter-clockwise seen from outside; of how many these are a part."""

    arrays: Arrays
    of: int


def picture_of(thing: Filed) -> Picture:
    """What an object looks like. ConfigError, naming it, for a file that cannot be used any more."""
    if isinstance(thing, schema.Mesh):
        report, arrays = rendered(thing)
        return Picture(arrays, report.triangles)
    heights = read_heights(thing)
    rows, columns = (max(count - 1, 1) for count in heights.shape)
    return Picture(relief(*thinned(heights, thing.pitch_m, MAP_PIXELS)), 2 * rows * columns)


def relief(x: Grid, y: Grid, z: Grid) -> Arrays:
    """Two triangles for each cell between heights (rows, columns) at x (columns,) and y (rows,), facing upwards, m.

    A map of one row or one column, which is a profile without an end, is as deep as it is wide.
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
