"""Initial camera of a scene: close enough to show a touch, far enough to show the complete scene."""

from __future__ import annotations

from collections.abc import Sequence
from math import sin
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.server.viewer.nodes.glyphs import rotated
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.nodes.meshes import mesh_of

if TYPE_CHECKING:
    from softfinger.server.viewer.nodes.bodies import Place

Array = NDArray[np.float64]
Shown = Sequence[tuple[Any, "Place"]]


class Camera(NamedTuple):
    """Position and target of the camera, in the page's units, and the vertical field of view, rad."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    fov: float


FOV: Final = 0.75
ASIDE: Final = np.array([4.5, -8.5, 4.9])
FRONT: Final = np.array([0.0, -10.5, 4.4])
"""Minimum offset from the target to the camera. FRONT suits fingers on both sides of an object, which hides neither."""
UP: Final = np.array([0.0, 0.0, 1.0])
SIDES: Final = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0)])
"""Mirrored views; the first one that shows most planes from their front is used."""
BESIDE_M: Final = np.array([0.02, 0.02, 0.019])
"""Visible surroundings of a point on an infinite surface."""
ABOVE_M: Final = 0.006
"""Height of the picture's centre above an infinite surface, where the fingertip is."""
HILLS_M: Final = 0.03
"""Visible surroundings of the centre of a height map."""
LIFTED_M: Final = 0.1
"""Height to which several fingers lift a body in the shipped scenes."""
FAR_M: Final = 0.05
"""Maximum distance from an object's centre that the picture includes; farther, a touch would be too small."""


def camera_of(scene: schema.Scene, drawn: dict[int, Array] | None = None, shown: Shown | None = None) -> Camera:
    """Return the initial camera of a scene.

    Hollow objects do not enlarge the picture, unless there are no other ones: they are larger than a touch and fill it
    anyway.

    Parameters
    ----------
    drawn
        Vertices (n, 3) m of objects that are loaded from files, by index.
    shown
        Drawn objects with their poses; None: the scene's objects at their initial poses.
    """
    reach = 2.0 * max(max(finger.radii_m or (finger.radius_m,)) for finger in scene.fingers)
    things = shown or [(thing, (thing.position_m, thing.orientation_wxyz)) for thing in scene.object]
    boxes = [_ends(thing, place, reach, (drawn or {}).get(k)) for k, (thing, place) in enumerate(things)]
    solid = [box for box, (thing, _) in zip(boxes, things, strict=True) if not getattr(thing, "inside", False)]
    ends = np.concatenate(solid or boxes)
    if scene.world is not None and len(scene.fingers) > 1:
        ends = np.concatenate([ends, ends + LIFTED_M * UP])
    low, high = ends.min(axis=0), ends.max(axis=0)
    middle, radius = CM * 0.5 * (low + high), CM * 0.5 * float(np.linalg.norm(high - low))
    way = ASIDE if len(scene.fingers) == 1 else FRONT
    walls = [rotated(thing.orientation_wxyz, UP) for thing in scene.object if isinstance(thing, schema.Plane)]
    way = max((way * sides for sides in SIDES), key=lambda each: sum(float(wall @ each) > 0.0 for wall in walls))
    way = way * max(1.0, radius / sin(0.5 * FOV) / float(np.linalg.norm(way)))
    x, y, z = (middle + way).tolist()
    return Camera((x, y, z), tuple(middle.tolist()), FOV)


def _ends(thing: Any, place: Place, reach: float, drawn: Array | None) -> Array:
    """Return the corners (2, 3) m, world frame, of a box around an object with a fingertip on it."""
    position = np.array(place[0])
    mesh = mesh_of(thing)
    points = drawn if drawn is not None and len(drawn) else None if mesh is None else mesh.vertices
    if isinstance(thing, schema.Plane) or points is None:
        middle = position + ABOVE_M * UP
        return np.array([middle - BESIDE_M, middle + BESIDE_M])
    if isinstance(thing, schema.Heightmap):
        points = points[(np.abs(points[:, :2]) <= HILLS_M).all(axis=1)]
    corners = rotated(place[1], np.clip(points, -FAR_M, FAR_M))
    return np.array([position + corners.min(axis=0) - 0.5 * reach, position + corners.max(axis=0) + reach])
