"""Textures: what is fine about a surface."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly


class Relief(NamedTuple):
    """Heights of a texture: how far its lowest value lies below its highest, m, which is the surface."""

    height: float


class Grip(NamedTuple):
    """Factors of friction at the lowest and at the highest value of a texture."""

    low: float
    high: float


class Texture(NamedTuple):
    """Values in [0, 1] over the coordinates of a surface: a bicubic B-spline about its origin.

    values           (rows * columns,)  its coefficients, row by row
    columns, rows                       how many
    per_u, per_v     1/m                columns and rows per length
    period_u         1 if the array repeats along u, 0 if its border goes on
    period_v         the same along v
    fade             m                  over which the texture ends before an edge of the object
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
