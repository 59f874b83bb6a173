"""Shape of a fingertip on the page: the rendered ellipsoid, continued as a finger with a nail, and soft shadows."""

from __future__ import annotations

from math import cos, pi, radians, sin
from typing import Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.server.surface_meshes import SurfaceMesh, revolve
from softfinger.server.viewer.nodes.below import UP
from softfinger.server.viewer.nodes.glyphs import rotate
from softfinger.server.viewer.nodes.looks import CM, NAIL, SHADOW, SKIN

TILT_RAD: Final = radians(45.0)
"""Angle of the finger's axis from the vertical, away from the camera, so that the nail faces it."""
LENGTH: Final = 1.7
"""Distance from the centre of the fingertip to that of the finger's other end, in radii."""
NAIL_SHELL: Final = 1.02
"""Distance of the nail from the axis, relative to the skin."""
NAIL_HALF_WIDTH_RAD: Final = 0.68
NAIL_CENTRE, NAIL_HALF_LENGTH = 0.1, 0.66
NAIL_CORNERS: Final = 13
"""Corners per side of the nail."""
SHADOW_STEPS: Final = 14
SHADOW_OPACITY: Final = 0.085
"""Discs of a shadow and the opacity of each: they add up towards the centre."""


def add_finger(api: Any, node: str, parts: schema.FingerParts) -> Any:
    radii = np.array(parts.radii_m or (parts.radius_m,) * 3)
    skin, _ = (
        api.add_mesh_simple(
            f"{node}/{name}",
            CM * rotate(parts.orientation_wxyz, mesh.vertices),
            mesh.faces,
            color=colour,
            opacity=opacity,
            cast_shadow=False,
        )
        for name, mesh, colour, opacity in (("ball", make_finger(radii), SKIN, 0.3), ("nail", nail(radii), NAIL, None))
    )
    return skin


def add_shadow(api: Any, node: str, radius: float) -> Any:
    """Add a horizontal shadow with a soft rim; return its frame."""
    frame = api.add_frame(node, show_axes=False)
    for k in range(SHADOW_STEPS):
        shade = make_disc(radius * (1.1 - 0.7 * k / SHADOW_STEPS))
        api.add_mesh_simple(
            f"{node}/{k}",
            shade.vertices + 1e-3 * k * UP,
            shade.faces,
            color=SHADOW,
            opacity=SHADOW_OPACITY,
            side="double",
            cast_shadow=False,
        )
    return frame


def make_finger(radii: Array) -> SurfaceMesh:
    """Return a finger whose tip is the ellipsoid with half axes `radii` (3,) about the origin.

    Its axis leaves the lower half of the ellipsoid uncovered, which usually touches. Only the ellipsoid is rendered.
    """
    angle = np.linspace(-0.5 * pi, 0.0, 13)
    tip = np.column_stack([np.cos(angle), np.sin(angle)])
    end = tip[::-1] * (1.0, -1.0) + (0.0, LENGTH)
    shape = revolve(np.concatenate([tip, end]))
    return SurfaceMesh(_tilt(shape.vertices) * radii, shape.faces)


def nail(radii: Array) -> SurfaceMesh:
    grid = np.linspace(-1.0, 1.0, NAIL_CORNERS)
    across, along = (
        values.ravel() for values in np.meshgrid(grid, np.sin(0.5 * pi * grid))
    )  # denser at the round ends
    height = NAIL_CENTRE + NAIL_HALF_LENGTH * along
    angle = -0.5 * pi + NAIL_HALF_WIDTH_RAD * across * (1.0 - 0.95 * along**4) ** 0.5
    radius = np.sqrt(1.0 - np.minimum(height, 0.0) ** 2)
    vertices = np.column_stack([
        NAIL_SHELL * radius * np.cos(angle), NAIL_SHELL * radius * np.sin(angle), NAIL_SHELL * height
    ])  # fmt: skip
    first = (NAIL_CORNERS * np.arange(NAIL_CORNERS - 1)[:, None] + np.arange(NAIL_CORNERS - 1)).ravel()
    corners = np.column_stack([first, first + 1, first + NAIL_CORNERS + 1, first + NAIL_CORNERS])
    faces = np.concatenate([corners[:, (0, 1, 2)], corners[:, (0, 2, 3)]]).astype(np.uint32)
    return SurfaceMesh(_tilt(vertices) * radii, faces)


def make_disc(radius: float) -> SurfaceMesh:
    return revolve(np.array([(radius, 0.0), (0.0, 0.0)]))


def _tilt(points: Array) -> Array:
    """Turn points (n, 3) about the x axis, from +z towards +y."""
    c, s = cos(TILT_RAD), sin(TILT_RAD)
    return np.asarray(points @ np.array([(1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)]))
