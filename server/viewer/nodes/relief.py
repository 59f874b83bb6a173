"""Height map with shading by height and by slope, as if lit from one side.

The page's light comes from all sides and gives smooth hills no shading.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from trimesh import Scene, Trimesh
from trimesh.exchange.gltf import export_glb

from softfinger.server.surface_meshes import Mesh
from softfinger.server.viewer.nodes.board import UNLIT
from softfinger.server.viewer.nodes.looks import CM, Colour

LIGHT: Final = np.array([-0.6, -0.45, 0.66])
"""Direction to the light, a unit vector to three digits: from the left, as on maps."""
DARK: Final = 0.6
"""Relative brightness of the lowest point."""


def add_relief(api: Any, node: str, mesh: Mesh, colour: Colour) -> None:
    """Add the triangles of a height map, in its frame."""
    paint = shade_vertices(mesh, colour)
    surface = Trimesh(CM * mesh.vertices, mesh.faces, vertex_colors=paint, process=False)
    api.add_glb(node, export_glb(Scene(surface), tree_postprocessor=_unlit), cast_shadow=False, receive_shadow=False)


def _unlit(tree: dict[str, Any]) -> None:
    """Use the colours of the vertices without lighting, by a new material."""
    tree["extensionsUsed"] = [UNLIT]
    tree["materials"] = [{"extensions": {UNLIT: {}}}]
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            part["material"] = 0


def shade_vertices(mesh: Mesh, colour: Colour) -> NDArray[np.uint8]:
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
    shade = (DARK + (1.0 - DARK) * share) * (0.35 + 0.65 * lit)
    srgb = np.clip(np.outer(shade, colour) / 255.0, 0.0, 1.0)
    # Colours of vertices in glTF are linear: IEC 61966-2-1.
    rgb = 255.0 * np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.column_stack([rgb, np.full(len(rgb), 255.0)]).astype(np.uint8)
