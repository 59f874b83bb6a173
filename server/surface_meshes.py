"""Triangle meshes of objects and fingertips in their frame, m, fine enough to look smooth.

`TRIANGLES` at the end maps each shape to its mesh function.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.config.schema import shapes

Faces = NDArray[np.uint32]

CIRCLE_CORNERS: Final = 40
"""Corners of a circle: it deviates half a pixel on a usual page. Without a graphics card, each corner costs time."""
PLANE_M: Final = 0.13
"""Edge of the drawn part of a plane."""
ENDLESS_M: Final = 0.2
"""Length of the drawn part of an infinite cylinder."""


class SurfaceMesh(NamedTuple):
    """vertices (n, 3) m; faces (m, 3), counter-clockwise from outside; flat: draw sharp edges."""

    vertices: Array
    faces: Faces
    flat: bool = False


def decode_mesh(vertices: bytes, triangles: bytes) -> SurfaceMesh:
    """Decode the triangles of the command `mesh`; raises ValueError for an invalid vertex index."""
    points = np.frombuffer(vertices, "<f4").reshape(-1, 3).astype(np.float64)
    faces = np.frombuffer(triangles, "<u4").reshape(-1, 3)
    if len(faces) and faces.max() >= len(points):
        raise ValueError(f"a triangle has vertex {faces.max()}, but there are {len(points)}")
    return SurfaceMesh(points, faces)


def make_surface(obj: shapes.ObjectBase) -> SurfaceMesh | None:
    """Return the surface of an object; None for shapes of other packages and for objects loaded from files."""
    triangles = TRIANGLES.get(type(obj))
    return None if triangles is None else triangles(obj)


def make_plane(edge: float) -> SurfaceMesh:
    """Return a square centred at the origin, with outward normal z."""
    h = 0.5 * edge
    corners = [(-h, -h, 0.0), (h, -h, 0.0), (h, h, 0.0), (-h, h, 0.0)]
    return SurfaceMesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)], np.uint32), flat=True)


def make_ellipsoid(radii: tuple[float, float, float]) -> SurfaceMesh:
    """Return an ellipsoid with half lengths along x, y, z."""
    angle = np.linspace(-0.5 * pi, 0.5 * pi, CIRCLE_CORNERS // 2 + 1)
    unit = revolve(np.column_stack([np.cos(angle), np.sin(angle)]))
    return SurfaceMesh(unit.vertices * radii, unit.faces)


def make_cylinder(radius: float, length: float, closed: bool) -> SurfaceMesh:
    """Return a cylinder about the z axis; flat ends with sharp rims if `closed`."""
    h = 0.5 * length
    side = revolve(np.array([(radius, -h), (radius, h)]))
    if not closed:
        return side
    return join_meshes(revolve(np.array([(0.0, -h), (radius, -h)])), side, revolve(np.array([(radius, h), (0.0, h)])))


def make_capsule(radius: float, length: float) -> SurfaceMesh:
    """Return a capsule about the z axis; `length` is the distance between the centres of its round ends."""
    angle = np.linspace(0.0, 0.5 * pi, CIRCLE_CORNERS // 4 + 1)
    end = np.column_stack([radius * np.cos(angle), radius * np.sin(angle) + 0.5 * length])
    return revolve(np.concatenate([end[::-1] * (1.0, -1.0), end]))


def make_torus(major: float, minor: float) -> SurfaceMesh:
    """Return a torus about the z axis."""
    angle = np.linspace(0.0, 2.0 * pi, CIRCLE_CORNERS + 1)
    return revolve(np.column_stack([major + minor * np.cos(angle), minor * np.sin(angle)]))


def make_box(size: tuple[float, float, float]) -> SurfaceMesh:
    """Return a box with full lengths along x, y, z."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return SurfaceMesh(corners, np.array(faces, np.uint32), flat=True)


def make_cone(height: float, radius: float) -> SurfaceMesh:
    """Return an open cone from its apex at the origin along +z."""
    return revolve(np.array([(0.0, 0.0), (radius, height)]))


def revolve(profile: Array) -> SurfaceMesh:
    """Rotate a profile (n, 2) of radius and z about the z axis; the outside is to the right of its direction."""
    angle = np.linspace(0.0, 2.0 * pi, CIRCLE_CORNERS, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rings = [np.column_stack([r * circle, np.full(CIRCLE_CORNERS, z)]) for r, z in profile]
    corner = np.arange(CIRCLE_CORNERS)
    next_corner = np.roll(corner, -1)
    faces = []
    for ring in range(len(profile) - 1):
        low, high = ring * CIRCLE_CORNERS, (ring + 1) * CIRCLE_CORNERS
        faces += [np.column_stack([low + corner, low + next_corner, high + next_corner])]
        faces += [np.column_stack([low + corner, high + next_corner, high + corner])]
    return SurfaceMesh(np.concatenate(rings), np.concatenate(faces).astype(np.uint32))


def join_meshes(*parts: SurfaceMesh) -> SurfaceMesh:
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])]).astype(np.uint32)
    faces = [part.faces + start for part, start in zip(parts, first, strict=True)]
    return SurfaceMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


TRIANGLES: Final[dict[type[shapes.ObjectBase], Callable[[Any], SurfaceMesh]]] = {
    shapes.Plane: lambda obj: make_plane(PLANE_M),
    shapes.Sphere: lambda obj: make_ellipsoid((obj.radius_m,) * 3),
    shapes.Cylinder: lambda obj: make_cylinder(
        obj.radius_m, obj.length_m or ENDLESS_M, closed=obj.length_m is not None
    ),
    shapes.Capsule: lambda obj: make_capsule(obj.radius_m, obj.length_m),
    shapes.Box: lambda obj: make_box(obj.size_m),
    shapes.Ellipsoid: lambda obj: make_ellipsoid(obj.semi_axes_m),
    shapes.Torus: lambda obj: make_torus(obj.major_radius_m, obj.minor_radius_m),
}
"""Function that returns the surface of each shape, by its configuration class."""
