"""Nodes of the objects of a scene at their poses in a tick, and of the other geoms of its [world]."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.mjcf_geoms import convert_geoms
from softfinger.proxy.actions import compile_motion
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.query.motion import compose_pose, compute_pose
from softfinger.proxy.pictures import Filed
from softfinger.proxy.record import AT
from softfinger.server.surface_meshes import PLANE_M, SurfaceMesh, make_surface
from softfinger.server.viewer.nodes.below import PlaneSurface, Projection, TriangleSurface
from softfinger.server.viewer.nodes.glyphs import PoseTuple
from softfinger.server.viewer.nodes.looks import CM, MAP, OBJECTS, Colour
from softfinger.server.viewer.nodes.unlit import add_board, add_relief

BOARD_SQUARES: Final = 13
"""Squares per side of a plane's board, one centimetre each."""


class SceneStart(NamedTuple):
    """Start of the rendering of a scene.

    missed     deadlines missed before it
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


class BodyNodes:
    """Nodes `/objects/N`: a frame with a surface for each object. `start` determines the time of moving objects."""

    def __init__(self, api: Any, scene: schema.Scene, start: SceneStart) -> None:
        self.start = start
        self._api, self._scene = api, scene
        self._root = api.add_frame("/objects", show_axes=False)
        self._frames: list[Any] = []
        self.poses: Final[list[PoseTuple]] = []
        """Poses of the objects: position (3,) m and orientation, object to world."""
        self._moving: Final[dict[int, tuple[Any, Pose]]] = {}
        self._body_attachments: Final[dict[int, tuple[str, PoseTuple]]] = {}
        """Objects on a body of [world]: name of the body, and pose in its frame."""
        self._surfaces: Final[dict[int, PlaneSurface | TriangleSurface]] = {}
        """Surfaces for `below`, if known."""
        self._deform: Callable[[Mapping[str, NDArray[np.float64]]], None] | None = None
        """Function that draws the elastic object, if its body is known."""
        self._objects = (*scene.object, *list_visual_geoms(scene))
        for scene_index, obj in enumerate(self._objects):
            initial_pose = (obj.position_m, obj.orientation_wxyz)
            self.poses.append(initial_pose)
            self._frames.append(api.add_frame(f"/objects/{scene_index}", show_axes=False))
            self._update_frame(scene_index)
            if isinstance(obj.motion, schema.Body):
                self._body_attachments[scene_index] = (obj.motion.body, initial_pose)
            elif obj.motion is not None:
                self._moving[scene_index] = (compile_motion(obj.motion), Pose(*initial_pose))
            _add_object(api, f"/objects/{scene_index}", obj, _choose_colour(scene_index, obj))
            if obj.shape == "plane":
                self._surfaces[scene_index] = PlaneSurface()
            elif not isinstance(obj, Filed) and (mesh := make_surface(obj)) is not None:
                self._surfaces[scene_index] = TriangleSurface(mesh)

    def draw(self, scene_index: int, mesh: SurfaceMesh) -> None:
        """Draw the triangles of an object that is loaded from a file."""
        obj = self._scene.object[scene_index]
        if len(mesh.faces):  # thinning may leave nothing of a mesh of tiny parts
            self._surfaces[scene_index] = TriangleSurface(mesh)
            drawn = _add_surface(
                self._api, f"/objects/{scene_index}", obj, mesh._replace(flat=True), _choose_colour(scene_index, obj)
            )
            if isinstance(obj, schema.Mesh) and obj.elastic is not None:
                self._deform = _make_deformation(obj, mesh.vertices, drawn)

    def show(self, row: NDArray[np.float64]) -> None:
        """Move the objects with a motion to their poses in a tick (RECORD_SIZE,)."""
        time = self.start.time(row)
        for scene_index, (motion, initial) in self._moving.items():
            pose = compute_pose(motion, initial, time)
            self.poses[scene_index] = (pose.position, pose.orientation)
            self._update_frame(scene_index)

    def deform(self, rows: Mapping[str, NDArray[np.float64]]) -> None:
        """Draw an elastic object under its contacts in a tick: the record (RECORD_SIZE,) of each finger by name."""
        if self._deform is not None:
            self._deform(rows)

    def move_bodies(self, bodies: Mapping[str, PoseTuple]) -> None:
        """Move the objects on bodies to the poses of these bodies (name, world frame)."""
        for scene_index, (name, (position, orientation)) in self._body_attachments.items():
            if name in bodies:
                carried_pose = compose_pose(Pose(*bodies[name]), position, orientation)
                self.poses[scene_index] = (carried_pose.position, carried_pose.orientation)
                self._update_frame(scene_index)

    def drive(self, scene_index: int, position: Any, orientation: Any = None) -> None:
        pose = (tuple(position), self.poses[scene_index][1] if orientation is None else tuple(orientation))
        self.poses[scene_index] = pose
        if scene_index in self._moving:
            self._moving[scene_index] = (self._moving[scene_index][0], Pose(*pose))
        self._update_frame(scene_index)

    def _update_frame(self, scene_index: int) -> None:
        (x, y, z), orientation = self.poses[scene_index]
        self._frames[scene_index].position = (CM * x, CM * y, CM * z)
        self._frames[scene_index].wxyz = orientation

    def drawn_objects(self) -> list[tuple[Any, PoseTuple]]:
        return list(zip(self._objects, self.poses, strict=True))

    def below(self, point: NDArray[np.float64]) -> Projection | None:
        """Return the highest point of an object straight below a point (3,) m; None if there is none."""
        projections = [
            projection._replace(scene_index=scene_index)
            for scene_index, surface in self._surfaces.items()
            if (projection := surface.below(point, self.poses[scene_index])) is not None
        ]
        return max(projections, key=lambda projection: float(projection.point[2]), default=None)

    def remove(self) -> None:
        self._root.remove()


def list_visual_geoms(scene: schema.Scene) -> list[schema.Object]:
    """Return the geoms of a scene's [world] without contact as objects to draw.

    Empty if the model cannot be read, for example because it is on another machine.
    """
    if scene.world is None:
        return []
    with_material = msgspec.structs.replace(scene.world, material=schema.Material(stiffness_n_per_m=1.0), geom=())
    contact_names = {obj.name for obj in scene.object}
    try:
        geoms = [geom.object for geom in convert_geoms(with_material) if geom.name not in contact_names]
    except ConfigError:
        return []
    return [obj for obj in geoms if obj is not None and not isinstance(obj, Filed)]


def _make_deformation(
    obj: schema.Mesh, vertices: NDArray[np.float64], drawn: Any
) -> Callable[[Mapping[str, NDArray[np.float64]]], None] | None:
    """Return the function that moves the vertices of the drawn surface; None if the body was not solved here."""
    from softfinger.proxy.elastic.deformed import Deformed  # only for scenes with an elastic object
    from softfinger.proxy.elastic.loads import compute_contact_loads
    from softfinger.proxy.elastic.prepared import load_stored_body

    body = load_stored_body(obj)
    if body is None:
        return None
    deformed = Deformed(obj, body, vertices)

    def draw(rows: Mapping[str, NDArray[np.float64]]) -> None:
        drawn.vertices = (CM * deformed.at(compute_contact_loads(obj, rows))).astype(np.float32)

    return draw


def _choose_colour(scene_index: int, obj: Any) -> Colour:
    return MAP if isinstance(obj, schema.Heightmap) else OBJECTS[scene_index % len(OBJECTS)]


def _add_object(api: Any, node: str, obj: Any, colour: tuple[int, int, int]) -> None:
    if isinstance(obj, Filed):  # `BodyNodes.draw` is called if the triangles arrive
        return
    mesh = make_surface(obj)
    if mesh is None:
        api.add_label(f"{node}/name", f"{obj.name}: no picture of a {obj.shape}")
        return
    if obj.shape == "plane":
        add_board(api, f"{node}/surface", CM * PLANE_M, BOARD_SQUARES, colour, opacity=0.85)
        return
    _add_surface(api, node, obj, mesh, colour)


def _add_surface(api: Any, node: str, obj: Any, mesh: SurfaceMesh, colour: tuple[int, int, int]) -> Any:
    """Add the surface of an object, and return its node; None for a height map."""
    if isinstance(obj, schema.Heightmap):
        add_relief(api, f"{node}/surface", mesh, colour)
        return None
    inside = getattr(obj, "inside", False)
    return api.add_mesh_simple(
        f"{node}/surface",
        CM * mesh.vertices,
        mesh.faces,
        color=colour,
        flat_shading=mesh.flat,
        side="back" if inside else "double",  # of a hollow object, only the far wall
        cast_shadow=False,
    )
