"""Vertical projection of a point onto the objects below it, for its plumb line and shadow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.server.viewer.nodes.glyphs import rotated

if TYPE_CHECKING:
    from softfinger.server.viewer.nodes.bodies import Place
    from softfinger.server.viewer.nodes.meshes import Mesh

Array = NDArray[np.float64]

LEVEL: Final = 0.5
"""Minimum cosine of the slope of a plane that counts as ground."""
ROUNDING: Final = 1e-9
"""Relative tolerance of the inside test of a triangle, so that no point on an edge is missed."""
UP: Final = np.array([0.0, 0.0, 1.0])


class Foot(NamedTuple):
    """End of a plumb line on a surface.

    point   (3,) m
    normal  (3,)  unit normal of the surface, upwards
    flat          whether the surface is flat
    number        index of the object in `Bodies.places`
    """

    point: Array
    normal: Array
    flat: bool
    number: int = -1


class Level:
    """Infinite plane."""

    def below(self, point: Array, place: Place) -> Foot | None:
        """Return the point straight below (3,) m; None if the plane is above or too steep."""
        normal = rotated(place[1], UP)
        if normal[2] <= LEVEL:
            return None
        height = point[2] - float(normal @ (point - np.array(place[0]))) / normal[2]
        return Foot(np.array([point[0], point[1], height]), normal, flat=True) if height <= point[2] else None


class Triangles:
    """Surface of triangles in its frame, m."""

    def __init__(self, mesh: Mesh) -> None:
        self._corners, self._flat = mesh.vertices[mesh.faces], mesh.flat
        self._place: Any = None

    def below(self, point: Array, place: Place) -> Foot | None:
        """Return the highest point of the surface straight below (3,) m; None if there is none."""
        if place != self._place:
            self._turn(place)
        x, y, z = point
        near = np.flatnonzero(
            (self._low[:, 0] <= x) & (x <= self._high[:, 0]) & (self._low[:, 1] <= y) & (y <= self._high[:, 1])
        )
        a, normal = self._world[near, 0], self._normal[near]
        heights = a[:, 2] - ((point - a)[:, :2] * normal[:, :2]).sum(axis=1) / normal[:, 2]
        under = np.column_stack([np.full(len(near), x), np.full(len(near), y), heights])
        inside, edge = heights <= z, -ROUNDING * (normal**2).sum(axis=1)
        for k in range(3):
            begin, end = self._world[near, k], self._world[near, (k + 1) % 3]
            inside &= (np.cross(end - begin, under - begin) * normal).sum(axis=1) >= edge
        if not inside.any():
            return None
        best = int(np.argmax(np.where(inside, heights, -np.inf)))
        up = normal[best] / np.linalg.norm(normal[best])
        return Foot(under[best], up if up[2] > 0.0 else -up, self._flat)

    def _turn(self, place: Place) -> None:
        """Transform the triangles to the world frame, without vertical ones, which have no point below another."""
        world = rotated(place[1], self._corners) + np.array(place[0])
        normal = np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0])
        lying = np.abs(normal[:, 2]) > 1e-6 * np.linalg.norm(normal, axis=1)
        self._world, self._normal, self._place = world[lying], normal[lying], place
        self._low, self._high = self._world.min(axis=1), self._world.max(axis=1)
