"""Where a scene is looked at from at first: near enough to see a touch, and so far that all of it is in the picture."""

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
    """Where it is and looks, in the page's units, and the angle from top to bottom, rad."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    fov: float


FOV: Final = 0.75
ASIDE: Final = np.array([4.5, -8.5, 4.9])
FRONT: Final = np.array([0.0, -10.5, 4.4])
"""From what is looked at to the camera, nearer than which it does not go. Of fingers on both sides of an object neither
is hidden by it from the front."""
UP: Final = np.array([0.0, 0.0, 1.0])
SIDES: Final = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0)])
"""Of four views the first from which most planes are seen from in front."""
BESIDE_M: Final = np.array([0.02, 0.02, 0.019])
"""How far around a place of an endless surface one sees at least."""
ABOVE_M: Final = 0.006
"""The middle of what is seen lies so far above an endless surface, where the fingertip is."""
HILLS_M: Final = 0.03
"""How far around the middle of a height map one sees."""
LIFTED_M: Final = 0.1
"""So high several fingers lift a body, as those of the shipped scenes do."""
FAR_M: Final = 0.05
"""Farther from its middle an object is not looked at: a touch would be too small."""


def camera_of(scene: schema.Scene, drawn: dict[int, Array] | None = None, shown: Shown | None = None) -> Camera:
    """Where a scene is looked at from at first; `drawn` has the vertices (n, 3) m of objects that are made of files,
    `shown` what else than the scene's objects is drawn, and where each is: without it they are where the scene has
    them. What is hollow is larger than a touch, and fills the picture anyway."""
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
    """Two corners (2, 3) m, of the world, of a box around what is to be seen of an object with a fingertip on it."""
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
