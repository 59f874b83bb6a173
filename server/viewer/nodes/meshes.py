"""Objects and fingertips as triangles, in their own frame, m: what the model touches, fine enough to look so.

A shape more is a line more in `TRIANGLES`, at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.schema import shapes

Array = NDArray[np.float64]
Faces = NDArray[np.uint32]

AROUND: Final = 40
"""Corners of a circle: half a pixel from round on a usual page, and each costs time without a graphics card."""
PLANE_M: Final = 0.13
"""Edge of what is drawn of a plane, which has no end."""
ENDLESS_M: Final = 0.2
"""Length of what is drawn of a cylinder without ends."""


class Mesh(NamedTuple):
    """vertices (n, 3) m; faces (m, 3), counter-clockwise seen from outside; flat: edges are edges."""

    vertices: Array
    faces: Faces
    flat: bool = False


def sent(vertices: bytes, triangles: bytes) -> Mesh:
    """Triangles as the command `mesh` gives them. ValueError for what cannot be some."""
    points = np.frombuffer(vertices, "<f4").reshape(-1, 3).astype(np.float64)
    faces = np.frombuffer(triangles, "<u4").reshape(-1, 3)
    if len(faces) and faces.max() >= len(points):
        raise ValueError(f"a triangle of vertex {faces.max()}, and there are {len(points)}")
    return Mesh(points, faces)


def mesh_of(thing: shapes.ObjectBase) -> Mesh | None:
    """The surface of an object; None for a shape of another package, which is not known here, and for one that is made
    of a file, whose triangles are in no table."""
    triangles = TRIANGLES.get(type(thing))
    return None if triangles is None else triangles(thing)


def plane(edge: float) -> Mesh:
    """A square about the origin, its outward normal z."""
    h = 0.5 * edge
    corners = [(-h, -h, 0.0), (h, -h, 0.0), (h, h, 0.0), (-h, h, 0.0)]
    return Mesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)], np.uint32), flat=True)


def ellipsoid(radii: tuple[float, float, float]) -> Mesh:
    """Half lengths along x, y, z."""
    angle = np.linspace(-0.5 * pi, 0.5 * pi, AROUND // 2 + 1)
    unit = lathe(np.column_stack([np.cos(angle), np.sin(angle)]))
    return Mesh(unit.vertices * radii, unit.faces)


def cylinder(radius: float, length: float, closed: bool) -> Mesh:
    """About the z axis, with flat ends or without; their rims are edges."""
    h = 0.5 * length
    side = lathe(np.array([(radius, -h), (radius, h)]))
    if not closed:
        return side
    return joined(lathe(np.array([(0.0, -h), (radius, -h)])), side, lathe(np.array([(radius, h), (0.0, h)])))


def capsule(radius: float, length: float) -> Mesh:
    """About the z axis; `length` lies between the centres of the round ends."""
    angle = np.linspace(0.0, 0.5 * pi, AROUND // 4 + 1)
    end = np.column_stack([radius * np.cos(angle), radius * np.sin(angle) + 0.5 * length])
    return lathe(np.concatenate([end[::-1] * (1.0, -1.0), end]))


def torus(major: float, minor: float) -> Mesh:
    """About the z axis."""
    angle = np.linspace(0.0, 2.0 * pi, AROUND + 1)
    return lathe(np.column_stack([major + minor * np.cos(angle), minor * np.sin(angle)]))


def box(size: tuple[float, float, float]) -> Mesh:
    """Full lengths along x, y, z."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return Mesh(corners, np.array(faces, np.uint32), flat=True)


def cone(height: float, radius: float) -> Mesh:
    """Open, from its apex in the origin up the z axis."""
    return lathe(np.array([(0.0, 0.0), (radius, height)]))


def lathe(profile: Array) -> Mesh:
    """A profile (n, 2) of radius and z, turned about the z axis; outside is to the right of its way."""
    angle = np.linspace(0.0, 2.0 * pi, AROUND, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rings = [np.column_stack([r * circle, np.full(AROUND, z)]) for r, z in profile]
    here = np.arange(AROUND)
    beside = np.roll(here, -1)
    faces = []
    for ring in range(len(profile) - 1):
        low, high = ring * AROUND, (ring + 1) * AROUND
        faces += [np.column_stack([low + here, low + beside, high + beside])]
        faces += [np.column_stack([low + here, high + beside, high + here])]
    return Mesh(np.concatenate(rings), np.concatenate(faces).astype(np.uint32))


def joined(*parts: Mesh) -> Mesh:
    """Several in one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])]).astype(np.uint32)
    faces = [part.faces + start for part, start in zip(parts, first, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


TRIANGLES: Final[dict[type[shapes.ObjectBase], Callable[[Any], Mesh]]] = {
    shapes.Plane: lambda thing: plane(PLANE_M),
    shapes.Sphere: lambda thing: ellipsoid((thing.radius_m,) * 3),
    shapes.Cylinder: lambda thing: cylinder(
        thing.radius_m, thing.length_m or ENDLESS_M, closed=thing.length_m is not None
    ),
    shapes.Capsule: lambda thing: capsule(thing.radius_m, thing.length_m),
    shapes.Box: lambda thing: box(thing.size_m),
    shapes.Ellipsoid: lambda thing: ellipsoid(thing.semi_axes_m),
    shapes.Torus: lambda thing: torus(thing.major_radius_m, thing.minor_radius_m),
}
"""What draws each shape: its table in a scene, to its surface."""
