"""The objects of a scene as nodes of the page, each where it is at a tick, and geoms of its [world] beside them."""

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
"""Of a side of a plane's board, a centimetre each."""

Place = tuple[tuple[float, float, float], Quaternion]


class Began(NamedTuple):
    """When a scene began to be rendered.

    tick       its first one
    missed     deadlines missed before it
    period_s   of a tick
    own_clock  all devices keep their own: a missed deadline is no time
    """

    tick: int
    missed: int
    period_s: float
    own_clock: bool

    def time(self, row: NDArray[np.float64]) -> float:
        """The scene's time in a tick (RECORD_SIZE,), s: the sum of the time steps of all ticks, seen or not."""
        missed = 0.0 if self.own_clock else row[AT.servo_missed] - self.missed
        return float(row[AT.tick] - self.tick + 1 + missed) * self.period_s


class Bodies:
    """Nodes `/objects/N`, a frame each with its surface below; `began` counts for those that move by themselves."""

    def __init__(self, api: Any, scene: schema.Scene, began: Began) -> None:
        self.began = began
        self._api, self._scene = api, scene
        self._root = api.add_frame("/objects", show_axes=False)
        self._frames: list[Any] = []
        self.places: Final[list[Place]] = []
        """Where each is: position (3,) m and orientation, object to world."""
        self._moving: Final[dict[int, tuple[Any, Pose]]] = {}
        self._riding: Final[dict[int, tuple[str, Place]]] = {}
        """Those that ride on a body: its name, and the place in its frame."""
        self._surfaces: Final[dict[int, Level | Triangles]] = {}
        """What may lie below a point, of those whose surface is known."""
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
        """The triangles of an object that is made of a file have come."""
        thing = self._scene.object[number]
        if len(mesh.faces):  # of crumbs alone nothing may be left
            self._surfaces[number] = Triangles(mesh)
            _put_surface(self._api, f"/objects/{number}", thing, mesh._replace(flat=True), _colour(number, thing))

    def show(self, row: NDArray[np.float64]) -> None:
        """Put those that move by themselves where they are in a tick (RECORD_SIZE,)."""
        time = self.began.time(row)
        for number, (motion, rest) in self._moving.items():
            pose = pose_at(motion, rest, time)
            self.places[number] = (pose.position, pose.orientation)
            self._put(number)

    def ride(self, bodies: Mapping[str, Place]) -> None:
        """Put those that ride on bodies where these are, in the world, by name."""
        for number, (name, (position, turn)) in self._riding.items():
            if name in bodies:
                there = carried(Pose(*bodies[name]), position, turn)
                self.places[number] = (there.position, there.orientation)
                self._put(number)

    def drive(self, number: int, position: Any, orientation: Any = None) -> None:
        """A driven object has been moved."""
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
        """What is drawn, and where it is."""
        return list(zip(self._things, self.places, strict=True))

    def below(self, point: NDArray[np.float64]) -> Foot | None:
        """The highest place straight below a point (3,) m; None where there is none."""
        feet = [
            foot._replace(number=number)
            for number, surface in self._surfaces.items()
            if (foot := surface.below(point, self.places[number])) is not None
        ]
        return max(feet, key=lambda foot: float(foot.point[2]), default=None)

    def remove(self) -> None:
        """With all that hangs on them."""
        self._root.remove()


def untouched(scene: schema.Scene) -> list[schema.Object]:
    """The geoms of a scene's [world] that no finger touches, as objects to be drawn; none where its model, which may be
    another machine's, cannot be read here."""
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
    if isinstance(thing, Filed):  # `Bodies.draw` is called later, or it cannot be had
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
        side="back" if inside else "double",  # of a hollow the far wall alone
        cast_shadow=False,
    )
