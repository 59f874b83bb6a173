"""Nodes of a fingertip: proxy, probe, contact points, forces and traces."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.record import AT, FREE, NAMED, PATCHES, SLIDING
from softfinger.server.viewer.nodes.bodies import Bodies
from softfinger.server.viewer.nodes.glyphs import DASHES, Way, arc, circles, dashes, inverse, rotated, towards
from softfinger.server.viewer.nodes.looks import (
    CM,
    CONE,
    GHOST,
    MARKS,
    NORMAL,
    PLUMB,
    SHADOW,
    SKIN,
    TORSION,
    Colour,
    Looks,
)
from softfinger.server.viewer.nodes.meshes import cone, ellipsoid, lathe
from softfinger.server.viewer.nodes.states import COLOURS, State, state_of

Array = NDArray[np.float64]

APART_M: Final = 2e-5
"""Proxy and probe closer than this are drawn as one."""
STEP_M: Final = 2e-4
"""Minimum length of a trace segment."""
ABOVE_M: Final = 2e-4
"""Height of traces above their surface, which would hide them otherwise."""
TRACED_EVERY: Final = 5
"""Ticks between two points of a trace."""
NOTHING_N: Final = 1e-4
"""Minimum force that is drawn."""
RECENT: Final = 100
"""Ticks over which rolling and spinning are detected."""
SHADE_M: Final = (6e-4, 1e-4)
"""Height of the shadow: above a curved surface, whose concave part would hide its rim, and above a flat one, below
the traces.
"""
LEAST_ARC: Final = radians(8.0)
"""Minimum arc (rad); a shorter one would be an arrow head without a line."""


def _three(at: int) -> slice:
    return slice(at, at + 3)


class Patch(NamedTuple):
    """First columns of a patch in a record."""

    object: int
    point: int
    normal: int
    mode: int


_PATCHES: Final = [Patch(*(NAMED[f"contacts{k}.{name}"].at for name in Patch._fields)) for k in range(PATCHES)]


class FingerNodes:
    """Nodes `/fingers/NAME`; `ball` is the part that a mouse can drag.

    Parameters
    ----------
    bodies
        Objects; the traces on them are in their frames.
    """

    def __init__(self, api: Any, scene: schema.Scene, finger: schema.FingerParts, bodies: Bodies) -> None:
        self._api, self._scene, self._bodies = api, scene, bodies
        self._node = f"/fingers/{finger.name or 'finger'}"
        self._radii = finger.radii_m or (finger.radius_m,) * 3
        shape = ellipsoid(self._radii)
        vertices = CM * rotated(finger.orientation_wxyz, shape.vertices)
        rings = CM * 1.004 * rotated(finger.orientation_wxyz, circles(self._radii))
        self._root = api.add_frame(self._node, show_axes=False)
        self._tip = api.add_frame(f"{self._node}/tip", show_axes=False)
        self.ball = api.add_mesh_simple(
            f"{self._node}/tip/ball", vertices, shape.faces, color=SKIN, opacity=0.75, cast_shadow=False
        )
        self._lines("tip/marks", rings, MARKS, 2.0)
        self._ghost = self._lines("probe", rings, GHOST, 2.0)
        self._apart = self._lines("apart", np.zeros((1, 2, 3)), GHOST, 3.0)
        self._force = api.add_arrows(
            f"{self._node}/force", np.zeros((1, 2, 3)), SKIN, shaft_radius=0.07, head_radius=0.18, head_length=0.35
        )
        self._lost = self._lines("not-displayed", np.zeros((DASHES, 2, 3)), PLUMB, 4.0)
        self._normals = self._lines("normals", np.zeros((PATCHES, 2, 3)), NORMAL, 2.5)
        self._dots = [
            api.add_icosphere(f"{self._node}/contact{k}", radius=0.12, color=SKIN, cast_shadow=False)
            for k in range(PATCHES)
        ]
        self._arc = self._lines("torsion", arc(1.0, 1.0), TORSION, 6.0)
        self._cone = api.add_mesh_simple(
            f"{self._node}/cone", *cone(1.0, 0.5)[:2], color=CONE, opacity=0.35, side="double", cast_shadow=False
        )
        self._slope = 0.5
        self._on_tip = Way(STEP_M)
        self._tip_trace = self._lines("tip/trace", self._on_tip.segments, SKIN, 3.5)
        self._on_objects: dict[int, tuple[Way, Any]] = {}
        self._touched = -1
        self._last: Array | None = None
        self.state = State.FREE
        """State of the contact."""
        self.displays: Callable[[Array], Array] | None = None
        """Function that returns the part (3,) N of a tick's force (RECORD_SIZE,) that the device displays; None: all of
        it."""
        self.height_m: float | None = None
        """Height of the fingertip's lowest point above the object below it, as for a sphere."""
        self._plumb = self._lines("plumb", np.zeros((1, 2, 3)), PLUMB, 2.0)
        disc = lathe(np.array([(CM * 0.75 * min(self._radii), 0.0), (0.0, 0.0)]))
        self._shadow = api.add_mesh_simple(
            f"{self._node}/shadow", disc.vertices, disc.faces, color=SHADOW, side="double", cast_shadow=False
        )

    def _lines(self, node: str, segments: Array, colour: Any, thickness: float) -> Any:
        return self._api.add_line_segments(
            f"{self._node}/{node}", segments, colour, thickness=thickness, thickness_units="screen"
        )

    def show(self, rows: Array, looks: Looks, newtons_per_cm: float) -> None:
        """Draw new ticks (n, RECORD_SIZE): the latest as a picture with arrows of the given scale, all as a trace."""
        row = rows[-1]
        probe, proxy = row[_three(AT.probe_position)], row[_three(AT.proxy_position)]
        mode = int(row[AT.contact_mode])
        apart = bool(np.linalg.norm(probe - proxy) > APART_M) and mode != FREE
        turn = tuple(row[AT.probe_orientation : AT.probe_orientation + 4])
        self._tip.position, self._tip.wxyz = CM * (proxy if apart else probe), turn
        self._ghost.position, self._ghost.wxyz = CM * probe, turn
        self._ghost.visible = self._apart.visible = apart and looks.ghost
        self._apart.points = CM * np.array([[probe, proxy]])
        last = rows[max(len(rows) - RECENT, 0)] if len(rows) > 1 else self._last if self._last is not None else row
        self.state, self._last = state_of(last, row, max(self._radii)), row
        self._show_wrench(row, mode, looks, newtons_per_cm)
        self._show_height(proxy if apart else probe)
        self._show_patches(row, mode != FREE and looks.patches)
        self._show_cone(row, mode != FREE and looks.cone, newtons_per_cm)
        self._trace(rows[::-1][::TRACED_EVERY][::-1], looks.traces)

    def _show_wrench(self, row: Array, mode: int, looks: Looks, newtons_per_cm: float) -> None:
        point, normal = row[_three(AT.contact_point)], row[_three(AT.contact_normal)]
        force = row[_three(AT.force)]
        begins = CM * (point if mode != FREE else row[_three(AT.probe_position)])
        shown = force if self.displays is None else self.displays(row)
        self._force.visible = bool(np.linalg.norm(shown) > NOTHING_N)
        self._force.points = np.array([[begins, begins + shown / newtons_per_cm]])
        self._lost.visible = bool(np.linalg.norm(force - shown) > NOTHING_N)
        self._lost.points = dashes(begins, (force - shown) / newtons_per_cm)
        self._force.colors = np.array(COLOURS[self.state], np.uint8)
        angle = radians(1e3 * float(row[AT.contact_torsion]) * looks.degrees_per_mnm)
        self._arc.visible = mode != FREE and abs(angle) > LEAST_ARC
        if self._arc.visible:
            self._arc.points = arc(angle, 1.35 * CM * max(self._radii))
            self._arc.position = CM * (point + 0.15 * self._radii[0] * normal)
            self._arc.wxyz = towards(normal)

    def _show_patches(self, row: Array, shown: bool) -> None:
        lines = np.zeros((PATCHES, 2, 3))
        for k, at in enumerate(_PATCHES):
            here = shown and row[at.object] >= 0.0
            self._dots[k].visible = here
            if here:
                point, normal = row[_three(at.point)], row[_three(at.normal)]
                self._dots[k].position, self._dots[k].color = CM * point, self._colour_of_patch(int(row[at.mode]))
                lines[k] = CM * point, CM * point + 2.5 * CM * max(self._radii) * normal
        self._normals.visible, self._normals.points = shown, lines

    def _show_cone(self, row: Array, shown: bool, newtons_per_cm: float) -> None:
        number, load = int(row[AT.contact_object]), float(row[AT.contact_normal_force])
        friction = self._scene.object[number].material.friction if 0 <= number < len(self._scene.object) else None
        self._cone.visible = shown and friction is not None and load > NOTHING_N
        if not self._cone.visible or friction is None:
            return
        if friction.static != self._slope:
            self._slope = friction.static
            self._cone.vertices = cone(1.0, self._slope).vertices
        self._cone.position = CM * row[_three(AT.contact_point)]
        self._cone.wxyz = towards(row[_three(AT.contact_normal)])
        self._cone.scale = load / newtons_per_cm

    def _colour_of_patch(self, mode: int) -> Colour:
        """Return the colour of a patch: a patch that sticks has the contact's state, unless another patch slides."""
        if mode == SLIDING:
            return COLOURS[State.SLIDING]
        return COLOURS[State.STICKING if self.state == State.SLIDING else self.state]

    def _show_height(self, centre: Array) -> None:
        """Draw a vertical line from the fingertip to the object below it, and its shadow there."""
        foot = self._bodies.below(centre)
        self._plumb.visible = self._shadow.visible = foot is not None
        self.height_m = None if foot is None else float(centre[2] - foot.point[2]) - min(self._radii)
        if foot is not None:
            self._plumb.points = CM * np.array([[centre, foot.point]])
            self._shadow.position = CM * (foot.point + SHADE_M[foot.flat] * foot.normal)
            self._shadow.wxyz = towards(foot.normal)

    def _trace(self, rows: Array, shown: bool) -> None:
        drawn = False
        for before, row in zip((rows[0], *rows[:-1]), rows, strict=True):
            mode, number = int(row[AT.contact_mode]), int(row[AT.contact_object])
            if not 0 <= number < len(self._bodies.places):  # a tick of another scene
                mode = FREE
            if mode == FREE or number != self._touched:
                self._lift(number if mode != FREE else -1)
            if mode == FREE:
                continue
            way = self._object_way(number)[0]
            on_tip, up = row[_three(AT.contact_finger_point)], row[_three(AT.contact_normal)]
            position, turn = self._bodies.places[number]
            above = row[_three(AT.contact_point)] + ABOVE_M * up - position
            on_tip = on_tip * (1.0 + 2.0 * ABOVE_M / max(float(np.linalg.norm(on_tip)), ABOVE_M))
            colour = COLOURS[state_of(before, row, max(self._radii)) if len(rows) > 1 else self.state]
            drawn |= way.add(rotated(inverse(turn), above), colour)
            drawn |= self._on_tip.add(on_tip, colour)
        self._tip_trace.visible = shown
        for way, node in self._on_objects.values():
            node.visible = shown
            if drawn:
                node.points, node.colors = CM * way.segments, way.colours
        if drawn:
            self._tip_trace.points, self._tip_trace.colors = CM * self._on_tip.segments, self._on_tip.colours

    def _object_way(self, number: int) -> tuple[Way, Any]:
        if number not in self._on_objects:
            way, name = Way(STEP_M), self._node.replace("/", "-")
            node = self._api.add_line_segments(
                f"/objects/{number}/trace{name}", way.segments, way.colours, thickness=3.5, thickness_units="screen"
            )
            self._on_objects[number] = (way, node)
        return self._on_objects[number]

    def _lift(self, number: int) -> None:
        self._touched = number
        for way in (self._on_tip, *(way for way, _ in self._on_objects.values())):
            way.lift()

    def forget(self) -> None:
        """Clear the traces."""
        for way, node in (*self._on_objects.values(), (self._on_tip, self._tip_trace)):
            way.clear()
            node.points = way.segments

    def change(self, scene: schema.Scene) -> None:
        """Set new parameters of the same objects."""
        self._scene = scene

    def remove(self) -> None:
        self._root.remove()
