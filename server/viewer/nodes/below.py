"""What lies straight below a point: where its plumb line ends, and its shadow lies."""

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
"""Cosine of the slope up to which a plane is a ground."""
ROUNDING: Final = 1e-9
"""Share of a triangle by which a point on its edge may lie outside, lest it fall between two."""
UP: Final = np.array([0.0, 0.0, 1.0])


class Foot(NamedTuple):
    """Where a plumb line ends: point (3,) m, the unit normal (3,) of the surface there, which points up; whether it is
    flat; of which object, by its number among the places."""

    point: Array
    normal: Array
    flat: bool
    number: int = -1


class Level:
    """An endless plane."""

    def below(self, point: Array, place: Place) -> Foot | None:
        """Where it lies straight below a point (3,) m; None where it is above, or too steep."""
        normal = rotated(place[1], UP)
        if normal[2] <= LEVEL:
            return None
        height = point[2] - float(normal @ (point - np.array(place[0]))) / normal[2]
        return Foot(np.array([point[0], point[1], height]), normal, flat=True) if height <= point[2] else None


class Triangles:
    """A surface of triangles, in its own frame, m."""

    def __init__(self, mesh: Mesh) -> None:
        self._corners, self._flat = mesh.vertices[mesh.faces], mesh.flat
        self._place: Any = None

    def below(self, point: Array, place: Place) -> Foot | None:
        """The highest place of it straight below a point (3,) m; None where there is none."""
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
        """Put them where they are in the world, without those that stand upright, which nothing lies on."""
        world = rotated(place[1], self._corners) + np.array(place[0])
        normal = np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0])
        lying = np.abs(normal[:, 2]) > 1e-6 * np.linalg.norm(normal, axis=1)
        self._world, self._normal, self._place = world[lying], normal[lying], place
        self._low, self._high = self._world.min(axis=1), self._world.max(axis=1)
