"""Surfaces that a fingertip can touch: their sizes, m, each in the frame of its shape."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


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


class MinkowskiSum(NamedTuple):
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


class Triangles(NamedTuple):
    """Triangles in the frame of the object, in the order of the tree that finds the nearest one.

    A node of the tree has eight lanes. What a lane holds, a node of its own or a triangle, lies within a box, one of
    its axes along the mean normal of what is in it, so that a patch of a smooth surface makes a thin one.

    nodes      (nodes * 12 * 8,) float32: x, y, z of the boxes' middles from `center`, m, of their normals, of the axes
                                 along their first sides, and halves of the sides, the normal's last, m; each of the
                                 eight lanes after another
    first      (nodes,)          int32: first child, the others behind it; ~ first triangle where lanes are those
    vertices   (vertices * 3,)   m, float64
    corners    (triangles * 3,)  int32: vertices of a triangle, counter-clockwise as seen from outside
    across     (triangles * 3,)  int32: the triangle beyond each edge, edge i from corner i to the next; -1 for none
    upward     (vertices * 3,)   normals at the vertices, each triangle counting as its angle there does
    number                       of triangles
    center     (3,) m            middle of the box round it
    size       m                 diagonal of that box
    side                         1 for a closed surface touched from outside, -1 from inside; 0 for an open one, which
                                 is touched on the side where the fingertip is
    shade                        1 where forces are along normals that vary over a triangle, 0 where along its own
    """

    nodes: ReadOnly
    first: ReadOnly
    vertices: ReadOnly
    corners: ReadOnly
    across: ReadOnly
    upward: ReadOnly
    number: float
    center: Vec3
    size: float
    side: float
    shade: float


class Mesh(NamedTuple):
    """A mesh: its Triangles in a row of one, so that what a kernel carries along is where they are and no more."""

    row: Rows


class AnyShape(NamedTuple):
    """A shape whose kind is data: one of many objects.

    sizes     a row with the named tuple of its kind
    kernels   addresses of the kernels of its kind (`shapes.any_shape`)
    facet     index of the triangle of a mesh that is meant, 0 for other shapes
    side      -1 if it is touched from inside, else 1
    surface   SMOOTH, FACETED for a mesh, CREASED for a height map, FLAT for a plane
    reach  m  radius of a ball about the origin of its frame that contains it; inf if none does
    """

    sizes: ReadOnly
    kernels: ReadOnly
    facet: float
    side: float
    surface: float
    reach: float


SMOOTH, FACETED, CREASED, FLAT = 0.0, 1.0, 2.0, 3.0
"""Surfaces of `AnyShape`: touched in one point, made of triangles, touched in several points as one body, a plane."""


class Facet(NamedTuple):
    """One triangle of a mesh, as an object of its own."""

    mesh: Mesh
    number: float
