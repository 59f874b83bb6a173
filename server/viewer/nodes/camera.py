"""Initial camera of a scene: close enough to show a touch, far enough to show the complete scene."""

from __future__ import annotations

from collections.abc import Sequence
from math import sin
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.server.surface_meshes import make_surface
from softfinger.server.viewer.nodes.below import UP
from softfinger.server.viewer.nodes.glyphs import PoseTuple, rotate
from softfinger.server.viewer.nodes.looks import CM

DrawnObjects = Sequence[tuple[Any, PoseTuple]]


class Camera(NamedTuple):
    """Position and target of the camera, in the page's units, and the vertical field of view, rad."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    fov: float


FOV: Final = 0.75
OBLIQUE_OFFSET: Final = np.array([4.5, -8.5, 4.9])
FRONT_OFFSET: Final = np.array([0.0, -10.5, 4.4])
"""Minimum offset from the target to the camera.

FRONT_OFFSET suits fingers on both sides of an object, which hides neither.
"""
VIEW_MIRRORS: Final = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0)])
"""Mirrored views; the first one that shows most planes from their front is used."""
PLANE_MARGIN_M: Final = np.array([0.02, 0.02, 0.019])
"""Visible surroundings of a point on an infinite surface."""
CENTRE_HEIGHT_M: Final = 0.006
"""Height of the picture's centre above an infinite surface, where the fingertip is."""
HEIGHTMAP_EXTENT_M: Final = 0.03
"""Visible surroundings of the centre of a height map."""
LIFT_HEIGHT_M: Final = 0.1
"""Height to which several fingers lift a body in the shipped scenes."""
MAX_EXTENT_M: Final = 0.05
"""Maximum distance from an object's centre that the picture includes; farther, a touch would be too small."""


def place_camera(
    scene: schema.Scene, file_vertices: dict[int, Array] | None = None, drawn_objects: DrawnObjects | None = None
) -> Camera:
    """Return the initial camera of a scene.

    Hollow objects do not enlarge the picture, unless there are no other ones: they are larger than a touch and fill it
    anyway.

    Parameters
    ----------
    file_vertices
        Vertices (n, 3) m of objects that are loaded from files, by index.
    drawn_objects
        Drawn objects with their poses; None: the scene's objects at their initial poses.
    """
    reach = 2.0 * max(max(finger.radii_m or (finger.radius_m,)) for finger in scene.fingers)
    objects = drawn_objects or [(obj, (obj.position_m, obj.orientation_wxyz)) for obj in scene.object]
    boxes = [
        _find_bounding_corners(obj, pose, reach, (file_vertices or {}).get(k)) for k, (obj, pose) in enumerate(objects)
    ]
    solid = [box for box, (obj, _) in zip(boxes, objects, strict=True) if not getattr(obj, "inside", False)]
    corners = np.concatenate(solid or boxes)
    if scene.world is not None and len(scene.fingers) > 1:
        corners = np.concatenate([corners, corners + LIFT_HEIGHT_M * UP])
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, radius = CM * 0.5 * (low + high), CM * 0.5 * float(np.linalg.norm(high - low))
    offset = OBLIQUE_OFFSET if len(scene.fingers) == 1 else FRONT_OFFSET
    walls = [rotate(obj.orientation_wxyz, UP) for obj in scene.object if isinstance(obj, schema.Plane)]
    offset = max(
        (offset * mirror for mirror in VIEW_MIRRORS), key=lambda view: sum(float(wall @ view) > 0.0 for wall in walls)
    )
    offset = offset * max(1.0, radius / sin(0.5 * FOV) / float(np.linalg.norm(offset)))
    x, y, z = (centre + offset).tolist()
    return Camera((x, y, z), tuple(centre.tolist()), FOV)


def _find_bounding_corners(obj: Any, pose: PoseTuple, reach: float, file_vertices: Array | None) -> Array:
    """Return the corners (2, 3) m, world frame, of a box around an object with a fingertip on it."""
    position = np.array(pose[0])
    mesh = make_surface(obj)
    points = (
        file_vertices if file_vertices is not None and len(file_vertices) else None if mesh is None else mesh.vertices
    )
    if isinstance(obj, schema.Plane) or points is None:
        centre = position + CENTRE_HEIGHT_M * UP
        return np.array([centre - PLANE_MARGIN_M, centre + PLANE_MARGIN_M])
    if isinstance(obj, schema.Heightmap):
        points = points[(np.abs(points[:, :2]) <= HEIGHTMAP_EXTENT_M).all(axis=1)]
    corners = rotate(pose[1], np.clip(points, -MAX_EXTENT_M, MAX_EXTENT_M))
    return np.array([position + corners.min(axis=0) - 0.5 * reach, position + corners.max(axis=0) + reach])
