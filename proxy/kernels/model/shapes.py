"""Shapes that a fingertip can touch: their sizes, m, each in its local frame."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class Plane(NamedTuple):
    """Half space {x : normal . x <= offset}, touched from outside."""

    normal: Vec3
    offset: float


class Sphere(NamedTuple):
    """Sphere about the origin of its frame; `side` is +1 if touched from outside, -1 from inside."""

    radius: float
    side: float


class Cylinder(NamedTuple):
    """Infinite cylinder about the z axis; `side` as for Sphere."""

    radius: float
    side: float


class CappedCylinder(NamedTuple):
    """Solid cylinder about the z axis with flat ends at z = +-half_length and sharp rims, touched from outside."""

    radius: float
    half_length: float


class Capsule(NamedTuple):
    """Cylinder about the z axis with hemispherical ends centred at z = +-half_length; `side` as for Sphere."""

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
    """Minkowski sum of a shape and an ellipsoidal fingertip, for which the fingertip acts as a ball of `radius`.

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
    """Torus of tube radius `minor` about the circle of radius `major` > `minor` in z = 0; `side` as for Sphere."""

    major: float
    minor: float
    side: float


class Heightmap(NamedTuple):
    """Solid below z = h(x, y): a bicubic spline through heights centred at the origin, level beyond its rim.

    pitch           m      distance between two heights
    columns, rows          numbers of cells, of one pitch each, including the three on each side where it levels off
    levels                 number of levels of tiles: see shapes/heightmap/tiles
    coefficients           of the spline, in pitches, row by row: one for each corner of a cell, one more on each side
    facets                 a, b1, b2, thick, valley, ridge of each tile, in pitches, level by level, row by row
    starts                 index of the first tile of each level
    """

    pitch: float
    columns: float
    rows: float
    levels: float
    coefficients: ReadOnly
    facets: ReadOnly
    starts: ReadOnly


class Triangles(NamedTuple):
    """Triangles in the object's frame, in the order of the tree for nearest-point queries.

    A node of the tree has eight lanes. A lane is a child node or a triangle, enclosed by an oriented box. One axis of
    the box is the mean normal of its content, so that a patch of a smooth surface has a thin box.

    nodes      (nodes * 12 * 8,) float32: x, y, z of the box centres relative to `center`, m, of the normals, of the
                                     axes along the first sides, and half sides, the one along the normal last, m; each
                                     for the eight lanes in turn
    first      (nodes,)          int32: index of the first child, then its siblings; ~ index of the first triangle
                                     if the lanes are triangles
    vertices   (vertices * 3,)   m, float64
    corners    (triangles * 3,)  int32: vertices of a triangle, counter-clockwise seen from outside
    across     (triangles * 3,)  int32: neighbouring triangle at each edge, edge i from corner i to the next; -1 if none
    upward     (vertices * 3,)   normals at the vertices, the mean of the triangles weighted by their angles there
    triangle_count               number of triangles
    center     (3,) m            centre of the bounding box
    size       m                 diagonal of the bounding box
    side                         1 for a closed surface touched from outside, -1 from inside; 0 for an open one, which
                                     is touched from the side of the fingertip
    shade                        1 if forces act along normals interpolated over a triangle, 0 along the face normal
    """

    nodes: ReadOnly
    first: ReadOnly
    vertices: ReadOnly
    corners: ReadOnly
    across: ReadOnly
    upward: ReadOnly
    triangle_count: float
    center: Vec3
    size: float
    side: float
    shade: float


class Mesh(NamedTuple):
    """Mesh: its Triangles as the only row of `Rows`, so that kernels pass an address instead of the tuple."""

    row: Rows


class AnyShape(NamedTuple):
    """A shape with its kind as data: one of many objects.

    sizes     a row with the named tuple of its kind
    kernels   addresses of the kernels of its kind (`shapes.any_shape`)
    facet     index of the triangle of a mesh that is meant, 0 for other shapes
    side      -1 if it is touched from inside, else 1
    surface   SMOOTH, FACETED for a mesh, CREASED for a height map, FLAT or WORLD_PLANE for a plane
    reach  m  radius of a ball about the origin of its frame that contains it; inf if none does; for a height map, a
              bound of its heights
    """

    sizes: ReadOnly
    kernels: ReadOnly
    facet: float
    side: float
    surface: float
    reach: float


SMOOTH, FACETED, CREASED, FLAT, WORLD_PLANE = 0.0, 1.0, 2.0, 3.0, 4.0
"""Surfaces of `AnyShape`: touched in one point, made of triangles, touched in several points as one body, a plane, a
plane whose frame is the world's."""


class Facet(NamedTuple):
    """One triangle of a mesh, as a shape."""

    mesh: Mesh
    triangle: float
