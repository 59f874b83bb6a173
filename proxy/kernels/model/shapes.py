"""Surfaces that a fingertip can touch: their sizes, m, each in the frame of its shape."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3
from softfinger.proxy.kernels.native.arrays import ReadOnly


class Plane(NamedTuple):
    """Half space {x : normal . x <= offset}, touched from outside."""

    normal: Vec3
    offset: float


class Sphere(NamedTuple):
    """Sphere about the origin of its frame; `side` is +1 touched from outside, -1 from inside."""

    radius: float
    side: float


class Cylinder(NamedTuple):
    """Endless cylinder about the z axis; `side` as for Sphere."""

    radius: float
    side: float


class CappedCylinder(NamedTuple):
    """Solid cylinder about the z axis with flat ends at z = +-half_length, sharp rims, touched from outside."""

    radius: float
    half_length: float


class Capsule(NamedTuple):
    """Cylinder about the z axis with round ends, whose centres are at z = +-half_length; `side` as for Sphere."""

    radius: float
    half_length: float
    side: float


class Box(NamedTuple):
    """Solid box |x_i| <= half_extents_i with sharp edges and corners, touched from outside."""

    half_extents: Vec3


class Ellipsoid(NamedTuple):
    """Ellipsoid sum (x_i / semi_axes_i)^2 = 1; `side` as for Sphere."""

    semi_axes: Vec3
    side: float


class Grown(NamedTuple):
    """A shape as the centre of an ellipsoidal fingertip sees it, which is then taken for a ball of `radius`.

    shape              Plane, Sphere or Cylinder, touched from outside
    semi_axes    (3,)  of the fingertip
    orientation  (4,)  of its axes in the frame of the shape
    radius
    """

    shape: Any
    semi_axes: Vec3
    orientation: Quaternion
    radius: float


class Torus(NamedTuple):
    """Ring of tube radius `minor` about the circle of radius `major` > `minor` in z = 0; `side` as for Sphere."""

    major: float
    minor: float
    side: float


class Heightmap(NamedTuple):
    """z = h(x, y), the solid below: a bicubic spline through heights about the origin, level beyond its rim.

    pitch           m      between two heights
    columns, rows          cells, of one pitch each, the three of the rim that it takes to level off included
    levels                 of tiles: see surfaces/tiles
    coefficients           of the spline, in pitches, row by row: one for each corner of a cell, and one more all round
    facets                 a, b1, b2, thick, valley, ridge of each tile, in pitches, level by level, row by row
    starts                 number of the first tile of each level
    """

    pitch: float
    columns: float
    rows: float
    levels: float
    coefficients: ReadOnly
    facets: ReadOnly
    starts: ReadOnly
