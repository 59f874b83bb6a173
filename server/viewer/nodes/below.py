"""Vertical projection of a point onto the objects below it, for its plumb line and shadow."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.server.surface_meshes import SurfaceMesh
from softfinger.server.viewer.nodes.glyphs import PoseTuple, rotate

MIN_GROUND_COSINE: Final = 0.5
"""Minimum cosine of the slope of a plane that counts as ground."""
ROUNDING: Final = 1e-9
"""Relative tolerance of the inside test of a triangle, so that no point on an edge is missed."""
UP: Final = np.array([0.0, 0.0, 1.0])


class Projection(NamedTuple):
    """End of a plumb line on a surface.

    point   (3,) m
    normal  (3,)  unit normal of the surface, upwards
    scene_index   index of the object in `BodyNodes.poses`
    """

    point: Array
    normal: Array
    flat: bool
    scene_index: int = -1


class PlaneSurface:
    """Infinite plane."""

    def below(self, point: Array, pose: PoseTuple) -> Projection | None:
        """Return the point straight below (3,) m; None if the plane is above or too steep."""
        normal = rotate(pose[1], UP)
        if normal[2] <= MIN_GROUND_COSINE:
            return None
        height = point[2] - float(normal @ (point - np.array(pose[0]))) / normal[2]
        return Projection(np.array([point[0], point[1], height]), normal, flat=True) if height <= point[2] else None


class TriangleSurface:
    """Surface of triangles in its frame, m."""

    def __init__(self, mesh: SurfaceMesh) -> None:
        self._corners, self._flat = mesh.vertices[mesh.faces], mesh.flat
        self._pose: Any = None

    def below(self, point: Array, pose: PoseTuple) -> Projection | None:
        """Return the highest point of the surface straight below (3,) m; None if there is none."""
        if pose != self._pose:
            self._transform(pose)
        x, y, z = point
        nearby = np.flatnonzero(
            (self._low[:, 0] <= x) & (x <= self._high[:, 0]) & (self._low[:, 1] <= y) & (y <= self._high[:, 1])
        )
        a, normal = self._world[nearby, 0], self._normal[nearby]
        heights = a[:, 2] - ((point - a)[:, :2] * normal[:, :2]).sum(axis=1) / normal[:, 2]
        candidates = np.column_stack([np.full(len(nearby), x), np.full(len(nearby), y), heights])
        inside, edge = heights <= z, -ROUNDING * (normal**2).sum(axis=1)
        for k in range(3):
            corner, next_corner = self._world[nearby, k], self._world[nearby, (k + 1) % 3]
            inside &= (np.cross(next_corner - corner, candidates - corner) * normal).sum(axis=1) >= edge
        if not inside.any():
            return None
        best = int(np.argmax(np.where(inside, heights, -np.inf)))
        up = normal[best] / np.linalg.norm(normal[best])
        return Projection(candidates[best], up if up[2] > 0.0 else -up, self._flat)

    def _transform(self, pose: PoseTuple) -> None:
        """Transform the triangles to the world frame, without vertical ones, which have no point below another."""
        world = rotate(pose[1], self._corners) + np.array(pose[0])
        normal = np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0])
        not_vertical = np.abs(normal[:, 2]) > 1e-6 * np.linalg.norm(normal, axis=1)
        self._world, self._normal, self._pose = world[not_vertical], normal[not_vertical], pose
        self._low, self._high = self._world.min(axis=1), self._world.max(axis=1)
