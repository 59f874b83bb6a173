"""Textures: height and friction variations of a surface, too fine for its shape."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly


class Relief(NamedTuple):
    """Heights of a texture: depth, m, of its lowest value below its highest, which is at the surface."""

    height: float


class Grip(NamedTuple):
    """Factors of friction at the lowest and at the highest value of a texture."""

    low: float
    high: float


class Texture(NamedTuple):
    """Values in [0, 1] over the coordinates of a surface: a bicubic B-spline centred at its origin.

    values           (rows * columns,)  its coefficients, row by row
    columns, rows                       their numbers
    per_u, per_v     1/m                columns and rows per length
    period_u         1 if the array repeats along u, 0 if its border values continue
    period_v         the same along v
    fade             m                  distance to an edge of the object over which the texture fades out
    relief           Relief or None
    grip             Grip or None
    """

    values: ReadOnly
    columns: float
    rows: float
    per_u: float
    per_v: float
    period_u: float
    period_v: float
    fade: float
    relief: Any
    grip: Any
