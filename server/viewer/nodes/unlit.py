"""Surfaces in colours independent of the light: a plane as a chessboard without its light squares, and height maps.

Without a graphics card, drawing time is proportional to the painted pixels, and a plane covers most of the picture. A
height map is shaded by height and by slope, as if lit from one side: the page's light comes from all sides and gives
smooth hills no shading.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from trimesh import Scene, Trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from softfinger.server.surface_meshes import SurfaceMesh
from softfinger.server.viewer.nodes.looks import CM, Colour

UNLIT: Final = "KHR_materials_unlit"
"""glTF extension; all materials of the page itself depend on the light."""
LIGHT: Final = np.array([-0.6, -0.45, 0.66])
"""Direction to the light, a unit vector to three digits: from the left, as on maps."""
MIN_BRIGHTNESS: Final = 0.6
"""Relative brightness of the lowest point."""


def add_board(api: Any, node: str, edge: float, count: int, colour: Colour, opacity: float) -> None:
    """Add a board of `count` squares per side, in the page's units, visible from above."""
    corners = make_squares(edge, count)
    faces = np.add.outer(4 * np.arange(len(corners)), [(0, 1, 2), (0, 2, 3)]).reshape(-1, 3)
    paint = PBRMaterial(baseColorFactor=[*colour, round(255 * opacity)], alphaMode="BLEND", metallicFactor=0.0)
    _add(api, node, Trimesh(corners.reshape(-1, 3), faces, visual=TextureVisuals(material=paint), process=False))


def add_relief(api: Any, node: str, mesh: SurfaceMesh, colour: Colour) -> None:
    """Add the triangles of a height map, in its frame."""
    paint = shade_vertices(mesh, colour)
    _add(api, node, Trimesh(CM * mesh.vertices, mesh.faces, vertex_colors=paint, process=False))


def _add(api: Any, node: str, surface: Trimesh) -> None:
    glb = export_glb(Scene(surface), tree_postprocessor=_switch_light_off)
    api.add_glb(node, glb, cast_shadow=False, receive_shadow=False)


def _switch_light_off(tree: dict[str, Any]) -> None:
    """Switch the light off for all materials, and for colours of vertices, which have no material, by a new one."""
    tree["extensionsUsed"] = [UNLIT]
    for material in tree.setdefault("materials", [{}]):
        material["extensions"] = {UNLIT: {}}
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            part["material"] = 0


def make_squares(edge: float, count: int) -> NDArray[np.float64]:
    """Return the corners (n, 4, 3), counter-clockwise, of every other square of a horizontal board about the origin.

    count  squares per side, including the omitted ones
    """
    at = np.linspace(-0.5 * edge, 0.5 * edge, count + 1)
    column, row = np.nonzero(np.add.outer(np.arange(count), np.arange(count)) % 2 == 0)
    around = ((0, 0), (1, 0), (1, 1), (0, 1))
    return np.stack([np.column_stack([at[column + x], at[row + y], 0.0 * at[row]]) for x, y in around], axis=1)


def shade_vertices(mesh: SurfaceMesh, colour: Colour) -> NDArray[np.uint8]:
    """Return the colours (n, 4) of the vertices."""
    heights = mesh.vertices[:, 2]
    share = (heights - heights.min()) / max(float(np.ptp(heights)), 1e-9)
    normals = np.zeros_like(mesh.vertices)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    for k in range(3):
        np.add.at(normals, mesh.faces[:, k], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    lit = np.clip(normals @ LIGHT / LIGHT[2], 0.0, 1.3)  # 1 on horizontal parts
    shade = (MIN_BRIGHTNESS + (1.0 - MIN_BRIGHTNESS) * share) * (0.35 + 0.65 * lit)
    srgb = np.clip(np.outer(shade, colour) / 255.0, 0.0, 1.0)
    # Colours of vertices in glTF are linear: IEC 61966-2-1.
    rgb = 255.0 * np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.column_stack([rgb, np.full(len(rgb), 255.0)]).astype(np.uint8)
