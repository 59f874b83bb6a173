"""Triangle meshes: what a scene owns of one, and one triangle of it."""

from typing import NamedTuple

from softfinger.proxy.kernels.native.arrays import ReadOnly
from softfinger.proxy.kernels.native.rows import Rows


class Triangles(NamedTuple):
    """Triangles in the frame of the object, in the order of the tree that finds the nearest one.

    A node of the tree has eight lanes. What a lane holds, a node of its own or a triangle, lies within a disc: a short
    cylinder, its axis along the mean normal of what is in it, so that a patch of a smooth surface makes a thin one.

    nodes      (nodes * 8 * 8,)  float32: x, y, z of the discs' centres from `center`, m, x, y, z of their axes, radius
                                 and half height, m; each of the eight lanes after another
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
    center: tuple[float, float, float]
    size: float
    side: float
    shade: float


class Mesh(NamedTuple):
    """A mesh: its Triangles in a row of one, so that what a kernel carries along is where they are and no more."""

    row: Rows


class Facet(NamedTuple):
    """One triangle of a mesh, as an object of its own."""

    mesh: Mesh
    number: float
