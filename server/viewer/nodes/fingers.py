"""Nodes of a fingertip: proxy, probe, contact points, forces and traces."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.drivers.quaternions import conjugate
from softfinger.proxy.record import AT, FREE, NAMED, PATCHES, SLIDING
from softfinger.server.surface_meshes import make_cone
from softfinger.server.viewer.nodes.below import UP
from softfinger.server.viewer.nodes.bodies import BodyNodes
from softfinger.server.viewer.nodes.fingertip import add_finger, add_shadow, make_disc
from softfinger.server.viewer.nodes.glyphs import (
    DASHES,
    Trace,
    make_arc,
    make_circles,
    make_dashes,
    rotate,
    rotate_z_to,
)
from softfinger.server.viewer.nodes.looks import (
    CM,
    COLOURS,
    CONE,
    GHOST,
    NORMAL,
    PLUMB,
    SKIN,
    STATE_TICKS,
    TORSION,
    Colour,
    Looks,
    VisibleState,
    classify_contact,
)

MIN_SEPARATION_M: Final = 2e-5
"""Proxy and probe closer than this are drawn as one."""
STEP_M: Final = 2e-4
"""Minimum length of a trace segment."""
TRACE_HEIGHT_M: Final = 2e-4
"""Height of traces above their surface, which would hide them otherwise."""
TRACE_TICKS: Final = 5
"""Ticks between two points of a trace."""
MIN_DRAWN_FORCE_N: Final = 1e-4
SHADOW_HEIGHTS_M: Final = (6e-4, 1e-4)
"""Height of the shadow: above a curved surface, whose concave part would hide its rim, and above a flat one, below
the traces.
"""
PATCH_HEIGHT_M: Final = 3e-4
"""Height of the drawn contact patch above the surface, and above the shadow and the traces."""
LABEL_OFFSET_CM: Final = np.array([0.0, 0.0, 0.3])
"""Offset of the force's label from the arrow's tip: above it, whichever way the arrow points."""
SIDE: Final = np.array([1.2, 0.0, 0.0])
"""Offset of the torsion's label from the contact, in radii of the arc, if the arc is about horizontal: right of it."""
MIN_ARC_SLOPE: Final = 0.5
"""Minimum sine of the arc's tilt at which the label is below its lowest point."""
MIN_ARC_RAD: Final = radians(8.0)
"""Minimum arc (rad); a shorter one would be an arrow head without a line."""


def _set_text(label: Any, text: str) -> None:
    if label.text != text:  # each change is sent to every page
        label.text = text


def _read_xyz(at: int) -> slice:
    return slice(at, at + 3)


_PATCHES: Final = [
    tuple(NAMED[f"contacts{k}.{name}"].at for name in ("object", "point", "normal", "mode")) for k in range(PATCHES)
]
"""First columns of each patch in a record."""


class FingerNodes:
    """Nodes `/fingers/NAME`; `ball` is the part that a mouse can drag.

    Parameters
    ----------
    bodies
        Objects; the traces on them are in their frames.
    """

    def __init__(self, api: Any, scene: schema.Scene, parts: schema.FingerParts, bodies: BodyNodes) -> None:
        self._api, self.scene, self._bodies = api, scene, bodies
        self._node = f"/fingers/{parts.name or 'finger'}"
        self._radii = parts.radii_m or (parts.radius_m,) * 3
        self.radius: Final = max(self._radii)
        """Largest radius, m."""
        rings = CM * rotate(parts.orientation_wxyz, make_circles(self._radii))
        self._root = api.add_frame(self._node, show_axes=False)
        self._tip = api.add_frame(f"{self._node}/tip", show_axes=False)
        self.ball = add_finger(api, f"{self._node}/tip", parts)
        self._ghost = self._draw_lines("probe", rings, GHOST, 2.0)
        self._separation = self._draw_lines("apart", np.zeros((1, 2, 3)), GHOST, 3.0)
        self._force = api.add_arrows(
            f"{self._node}/force", np.zeros((1, 2, 3)), SKIN, shaft_radius=0.07, head_radius=0.18, head_length=0.35
        )
        self._missing_force = self._draw_lines("not-displayed", np.zeros((DASHES, 2, 3)), PLUMB, 4.0)
        self._normals = self._draw_lines("normals", np.zeros((PATCHES, 2, 3)), NORMAL, 2.5)
        self._dots = [
            api.add_icosphere(f"{self._node}/contact{k}", radius=0.12, color=SKIN, cast_shadow=False)
            for k in range(PATCHES)
        ]
        patch = make_disc(CM)
        self._patch = api.add_mesh_simple(
            f"{self._node}/patch", *patch[:2], color=SKIN, opacity=0.7, side="double", cast_shadow=False
        )
        self._arc = self._draw_lines("torsion", make_arc(1.0, 1.0), TORSION, 6.0)
        self._force_label, self._torsion_label = (
            api.add_label(f"{self._node}/{name}-label", "", anchor=anchor, font_screen_scale=1.2, visible=False)
            for name, anchor in (("force", "bottom-center"), ("torsion", "top-center"))
        )
        self._cone = api.add_mesh_simple(
            f"{self._node}/cone", *make_cone(1.0, 0.5)[:2], color=CONE, opacity=0.35, side="double", cast_shadow=False
        )
        self._slope = 0.5
        self._tip_trace = Trace(STEP_M)
        self._tip_trace_node = self._draw_lines("tip/trace", self._tip_trace.segments, SKIN, 3.5)
        self._object_traces: dict[int, tuple[Trace, Any]] = {}
        self._touched_object = -1
        self._last_row: Array | None = None
        self.state = VisibleState.FREE
        self.displayed_force: Callable[[Array], Array] | None = None
        """Function that returns the part (3,) N of a tick's force (RECORD_SIZE,) that the device displays; None: all of
        it."""
        self.gap_m: float | None = None
        """Gap between the fingertip's lowest point and the object below it, as for a sphere."""
        self._plumb = self._draw_lines("plumb", np.zeros((1, 2, 3)), PLUMB, 2.0)
        self._shadow = add_shadow(api, f"{self._node}/shadow", CM * min(self._radii))

    def _draw_lines(self, node: str, segments: Array, colour: Any, thickness: float) -> Any:
        node = node if node.startswith("/") else f"{self._node}/{node}"
        return self._api.add_line_segments(node, segments, colour, thickness=thickness, thickness_units="screen")

    def show(self, rows: Array, looks: Looks, newtons_per_cm: float) -> None:
        """Draw new ticks (n, RECORD_SIZE): the latest as a picture with arrows of the given scale, all as a trace."""
        row = rows[-1]
        probe, proxy = row[_read_xyz(AT.probe_position)], row[_read_xyz(AT.proxy_position)]
        mode = int(row[AT.contact_mode])
        is_separate = bool(np.linalg.norm(probe - proxy) > MIN_SEPARATION_M) and mode != FREE
        orientation = tuple(row[AT.probe_orientation : AT.probe_orientation + 4])
        self._tip.position, self._tip.wxyz = CM * (proxy if is_separate else probe), orientation
        self._ghost.position, self._ghost.wxyz = CM * probe, orientation
        self._ghost.visible = self._separation.visible = is_separate and looks.ghost
        self._separation.points = CM * np.array([[probe, proxy]])
        earlier = row if self._last_row is None else self._last_row
        if len(rows) > 1:
            earlier = rows[max(len(rows) - STATE_TICKS, 0)]
        self.state, self._last_row = classify_contact(earlier, row, self.radius), row
        self._show_wrench(row, mode, looks, newtons_per_cm)
        self._show_gap(proxy if is_separate else probe)
        self._show_patches(row, mode != FREE and looks.patches)
        self._show_cone(row, mode != FREE and looks.cone, newtons_per_cm)
        self._trace(rows[::-1][::TRACE_TICKS][::-1], looks.traces)

    def _show_wrench(self, row: Array, mode: int, looks: Looks, newtons_per_cm: float) -> None:
        point, normal = row[_read_xyz(AT.contact_point)], row[_read_xyz(AT.contact_normal)]
        force = row[_read_xyz(AT.force)]
        start = CM * (point if mode != FREE else row[_read_xyz(AT.probe_position)])
        displayed = force if self.displayed_force is None else self.displayed_force(row)
        self._force.visible = bool(np.linalg.norm(displayed) > MIN_DRAWN_FORCE_N)
        self._force.points = np.array([[start, start + displayed / newtons_per_cm]])
        self._missing_force.visible = bool(np.linalg.norm(force - displayed) > MIN_DRAWN_FORCE_N)
        self._missing_force.points = make_dashes(start, (force - displayed) / newtons_per_cm)
        self._force.colors = np.array(COLOURS[self.state], np.uint8)
        self._force_label.visible = self._force.visible
        self._force_label.position = start + displayed / newtons_per_cm + LABEL_OFFSET_CM
        _set_text(self._force_label, f"{np.linalg.norm(displayed):.1f} N")
        angle = radians(1e3 * float(row[AT.contact_torsion]) * looks.degrees_per_mnm)
        self._arc.visible = self._torsion_label.visible = mode != FREE and abs(angle) > MIN_ARC_RAD
        if self._arc.visible:
            down = normal[2] * normal - UP  # in the plane of the arc
            slope = float(np.linalg.norm(down))
            direction = down / slope if slope > MIN_ARC_SLOPE else SIDE
            self._torsion_label.position = CM * (point + 1.35 * self.radius * direction)
            _set_text(self._torsion_label, f"{1e3 * row[AT.contact_torsion]:.1f} mN m")
            self._arc.points = make_arc(angle, 1.35 * CM * self.radius)
            self._arc.position = CM * (point + 0.15 * self._radii[0] * normal)
            self._arc.wxyz = rotate_z_to(normal)

    def _show_patches(self, row: Array, is_shown: bool) -> None:
        lines = np.zeros((PATCHES, 2, 3))
        for k, (object_at, point_at, normal_at, mode_at) in enumerate(_PATCHES):
            is_visible = is_shown and row[object_at] >= 0.0
            self._dots[k].visible = is_visible
            if is_visible:
                point, normal = row[_read_xyz(point_at)], row[_read_xyz(normal_at)]
                self._dots[k].position, self._dots[k].color = CM * point, self._choose_patch_colour(int(row[mode_at]))
                lines[k] = CM * point, CM * point + 2.5 * CM * self.radius * normal
        self._normals.visible, self._normals.points = is_shown, lines
        radius = float(row[AT.contact_patch_radius])
        self._patch.visible = is_shown and radius > 0.0
        if self._patch.visible:
            normal = row[_read_xyz(AT.contact_normal)]
            self._patch.position = CM * (row[_read_xyz(AT.contact_point)] + PATCH_HEIGHT_M * normal)
            self._patch.wxyz, self._patch.scale = rotate_z_to(normal), radius
            self._patch.color = COLOURS[self.state]

    def _show_cone(self, row: Array, is_shown: bool, newtons_per_cm: float) -> None:
        scene_index, normal_force = int(row[AT.contact_object]), float(row[AT.contact_normal_force])
        objects = self.scene.object
        friction = objects[scene_index].material.friction if 0 <= scene_index < len(objects) else None
        self._cone.visible = is_shown and friction is not None and normal_force > MIN_DRAWN_FORCE_N
        if not self._cone.visible or friction is None:
            return
        if friction.static != self._slope:
            self._slope = friction.static
            self._cone.vertices = make_cone(1.0, self._slope).vertices
        self._cone.position = CM * row[_read_xyz(AT.contact_point)]
        self._cone.wxyz = rotate_z_to(row[_read_xyz(AT.contact_normal)])
        self._cone.scale = normal_force / newtons_per_cm

    def _choose_patch_colour(self, mode: int) -> Colour:
        """Return the colour of a patch: a patch that sticks has the contact's state, unless another patch slides."""
        if mode == SLIDING:
            return COLOURS[VisibleState.SLIDING]
        return COLOURS[VisibleState.STICKING if self.state == VisibleState.SLIDING else self.state]

    def _show_gap(self, centre: Array) -> None:
        """Draw a vertical line from the fingertip to the object below it, and its shadow there."""
        projection = self._bodies.below(centre)
        self._plumb.visible = self._shadow.visible = projection is not None
        self.gap_m = None if projection is None else float(centre[2] - projection.point[2]) - min(self._radii)
        if projection is not None:
            self._plumb.points = CM * np.array([[centre, projection.point]])
            self._shadow.position = CM * (projection.point + SHADOW_HEIGHTS_M[projection.flat] * projection.normal)
            self._shadow.wxyz = rotate_z_to(projection.normal)

    def _trace(self, rows: Array, is_shown: bool) -> None:
        has_new_segments = False
        for before, row in zip((rows[0], *rows[:-1]), rows, strict=True):
            mode, scene_index = int(row[AT.contact_mode]), int(row[AT.contact_object])
            if not 0 <= scene_index < len(self._bodies.poses):  # a tick of another scene
                mode = FREE
            if mode == FREE or scene_index != self._touched_object:
                self._touched_object = scene_index if mode != FREE else -1
                for trace, _ in self._list_traces():
                    trace.break_line()
            if mode == FREE:
                continue
            trace = self._make_object_trace(scene_index)[0]
            finger_point, up = row[_read_xyz(AT.contact_finger_point)], row[_read_xyz(AT.contact_normal)]
            position, orientation = self._bodies.poses[scene_index]
            above = row[_read_xyz(AT.contact_point)] + TRACE_HEIGHT_M * up - position
            length = max(float(np.linalg.norm(finger_point)), TRACE_HEIGHT_M)
            finger_point = finger_point * (1.0 + 2.0 * TRACE_HEIGHT_M / length)
            colour = COLOURS[classify_contact(before, row, self.radius) if len(rows) > 1 else self.state]
            has_new_segments |= trace.add(rotate(conjugate(orientation), above), colour)
            has_new_segments |= self._tip_trace.add(finger_point, colour)
        for trace, node in self._list_traces():
            node.visible = is_shown
            if has_new_segments:
                node.points, node.colors = CM * trace.segments, trace.colours

    def _make_object_trace(self, scene_index: int) -> tuple[Trace, Any]:
        if scene_index not in self._object_traces:
            trace, name = Trace(STEP_M), self._node.replace("/", "-")
            node = f"/objects/{scene_index}/trace{name}"
            self._object_traces[scene_index] = (trace, self._draw_lines(node, trace.segments, trace.colours, 3.5))
        return self._object_traces[scene_index]

    def _list_traces(self) -> list[tuple[Trace, Any]]:
        return [(self._tip_trace, self._tip_trace_node), *self._object_traces.values()]

    def clear_traces(self) -> None:
        for trace, node in self._list_traces():
            trace.clear()
            node.points = trace.segments

    def remove(self) -> None:
        self._root.remove()
