"""Nodes of the objects of a scene at their poses in a tick, and of the other geoms of its [world]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.mjcf_geoms import taken
from softfinger.proxy.actions import kernel_motion
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.query.motion import carried, pose_at
from softfinger.proxy.pictures import Filed
from softfinger.proxy.record import AT
from softfinger.server.viewer.nodes.below import Foot, Level, Triangles
from softfinger.server.viewer.nodes.board import add_board
from softfinger.server.viewer.nodes.glyphs import Quaternion
from softfinger.server.viewer.nodes.looks import CM, MAP, OBJECTS, Colour
from softfinger.server.viewer.nodes.meshes import PLANE_M, Mesh, mesh_of
from softfinger.server.viewer.nodes.relief import add_relief

SQUARES: Final = 13
"""Squares per side of a plane's board, one centimetre each."""

Place = tuple[tuple[float, float, float], Quaternion]


class Began(NamedTuple):
    """Start of the rendering of a scene.

    tick       its first tick
    missed     deadlines missed before it
    period_s   period of a tick
    own_clock  whether all devices have their own clock; if so, a missed deadline takes no time
    """

    tick: int
    missed: int
    period_s: float
    own_clock: bool

    def time(self, row: NDArray[np.float64]) -> float:
        """Return the scene's time in a tick (RECORD_SIZE,), s: the sum of all time steps since its start."""
        missed = 0.0 if self.own_clock else row[AT.servo_missed] - self.missed
        return float(row[AT.tick] - self.tick + 1 + missed) * self.period_s


class Bodies:
    """Nodes `/objects/N`: a frame with a surface for each object. `began` determines the time of moving objects."""

    def __init__(self, api: Any, scene: schema.Scene, began: Began) -> None:
        self.began = began
        self._api, self._scene = api, scene
        self._root = api.add_frame("/objects", show_axes=False)
        self._frames: list[Any] = []
        self.places: Final[list[Place]] = []
        """Poses of the objects: position (3,) m and orientation, object to world."""
        self._moving: Final[dict[int, tuple[Any, Pose]]] = {}
        self._riding: Final[dict[int, tuple[str, Place]]] = {}
        """Objects on a body of [world]: name of the body, and pose in its frame."""
        self._surfaces: Final[dict[int, Level | Triangles]] = {}
        """Surfaces for `below`, if known."""
        self._things = (*scene.object, *untouched(scene))
        for number, thing in enumerate(self._things):
            place = (thing.position_m, thing.orientation_wxyz)
            self.places.append(place)
            self._frames.append(api.add_frame(f"/objects/{number}", show_axes=False))
            self._put(number)
            if isinstance(thing.motion, schema.Body):
                self._riding[number] = (thing.motion.body, place)
            elif thing.motion is not None:
                self._moving[number] = (kernel_motion(thing.motion), Pose(*place))
            _draw(api, f"/objects/{number}", thing, _colour(number, thing))
            if thing.shape == "plane":
                self._surfaces[number] = Level()
            elif not isinstance(thing, Filed) and (mesh := mesh_of(thing)) is not None:
                self._surfaces[number] = Triangles(mesh)

    def draw(self, number: int, mesh: Mesh) -> None:
        """Draw the triangles of an object that is loaded from a file."""
        thing = self._scene.object[number]
        if len(mesh.faces):  # thinning may leave nothing of a mesh of tiny parts
            self._surfaces[number] = Triangles(mesh)
            _put_surface(self._api, f"/objects/{number}", thing, mesh._replace(flat=True), _colour(number, thing))

    def show(self, row: NDArray[np.float64]) -> None:
        """Move the objects with a motion to their poses in a tick (RECORD_SIZE,)."""
        time = self.began.time(row)
        for number, (motion, rest) in self._moving.items():
            pose = pose_at(motion, rest, time)
            self.places[number] = (pose.position, pose.orientation)
            self._put(number)

    def ride(self, bodies: Mapping[str, Place]) -> None:
        """Move the objects on bodies to the poses of these bodies (name, world frame)."""
        for number, (name, (position, turn)) in self._riding.items():
            if name in bodies:
                there = carried(Pose(*bodies[name]), position, turn)
                self.places[number] = (there.position, there.orientation)
                self._put(number)

    def drive(self, number: int, position: Any, orientation: Any = None) -> None:
        """Move a driven object."""
        place = (tuple(position), self.places[number][1] if orientation is None else tuple(orientation))
        self.places[number] = place
        if number in self._moving:
            self._moving[number] = (self._moving[number][0], Pose(*place))
        self._put(number)

    def _put(self, number: int) -> None:
        (x, y, z), turn = self.places[number]
        self._frames[number].position = (CM * x, CM * y, CM * z)
        self._frames[number].wxyz = turn

    def shown(self) -> list[tuple[Any, Place]]:
        """Return the drawn objects with their poses."""
        return list(zip(self._things, self.places, strict=True))

    def below(self, point: NDArray[np.float64]) -> Foot | None:
        """Return the highest point of an object straight below a point (3,) m; None if there is none."""
        feet = [
            foot._replace(number=number)
            for number, surface in self._surfaces.items()
            if (foot := surface.below(point, self.places[number])) is not None
        ]
        return max(feet, key=lambda foot: float(foot.point[2]), default=None)

    def remove(self) -> None:
        """Remove the frames with all their child nodes."""
        self._root.remove()


def untouched(scene: schema.Scene) -> list[schema.Object]:
    """Return the geoms of a scene's [world] without contact as objects to draw.

    Empty if the model cannot be read, for example because it is on another machine.
    """
    if scene.world is None:
        return []
    anything = msgspec.structs.replace(scene.world, material=schema.Material(stiffness_n_per_m=1.0), geom=())
    have = {thing.name for thing in scene.object}
    try:
        geoms = [each.object for each in taken(anything) if each.name not in have]
    except ConfigError:
        return []
    return [thing for thing in geoms if thing is not None and not isinstance(thing, Filed)]


def _colour(number: int, thing: Any) -> Colour:
    return MAP if isinstance(thing, schema.Heightmap) else OBJECTS[number % len(OBJECTS)]


def _draw(api: Any, node: str, thing: Any, colour: tuple[int, int, int]) -> None:
    if isinstance(thing, Filed):  # `Bodies.draw` is called if the triangles arrive
        return
    mesh = mesh_of(thing)
    if mesh is None:
        api.add_label(f"{node}/name", f"{thing.name}: no picture of a {thing.shape}")
        return
    if thing.shape == "plane":
        add_board(api, f"{node}/surface", CM * PLANE_M, SQUARES, colour, opacity=0.85)
        return
    _put_surface(api, node, thing, mesh, colour)


def _put_surface(api: Any, node: str, thing: Any, mesh: Mesh, colour: tuple[int, int, int]) -> None:
    if isinstance(thing, schema.Heightmap):
        add_relief(api, f"{node}/surface", mesh, colour)
        return
    inside = getattr(thing, "inside", False)
    api.add_mesh_simple(
        f"{node}/surface",
        CM * mesh.vertices,
        mesh.faces,
        color=colour,
        opacity=0.88,
        flat_shading=mesh.flat,
        side="back" if inside else "double",  # of a hollow object, only the far wall
        cast_shadow=False,
    )
