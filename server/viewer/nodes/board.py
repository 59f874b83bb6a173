"""Plane drawn as a chessboard without its light squares, in a colour independent of the light.

Without a graphics card, drawing time is proportional to the painted pixels, and a plane covers most of the picture.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from trimesh import Scene, Trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from softfinger.server.viewer.nodes.looks import Colour

UNLIT: Final = "KHR_materials_unlit"
"""glTF extension; all materials of the page itself depend on the light."""


def add_board(api: Any, node: str, edge: float, count: int, colour: Colour, opacity: float) -> None:
    """Add a board of `count` squares per side, in the page's units, visible from above."""
    corners = squares(edge, count)
    faces = np.add.outer(4 * np.arange(len(corners)), [(0, 1, 2), (0, 2, 3)]).reshape(-1, 3)
    paint = PBRMaterial(baseColorFactor=[*colour, round(255 * opacity)], alphaMode="BLEND", metallicFactor=0.0)
    board = Trimesh(corners.reshape(-1, 3), faces, visual=TextureVisuals(material=paint), process=False)
    api.add_glb(node, export_glb(Scene(board), tree_postprocessor=_unlit), cast_shadow=False, receive_shadow=False)


def _unlit(tree: dict[str, Any]) -> None:
    tree["extensionsUsed"] = [UNLIT]
    for material in tree["materials"]:
        material["extensions"] = {UNLIT: {}}


def squares(edge: float, count: int) -> NDArray[np.float64]:
    """Return the corners (n, 4, 3), counter-clockwise, of every other square of a horizontal board about the origin.

    edge   length of a side
    count  squares per side, including the omitted ones
    """
    at = np.linspace(-0.5 * edge, 0.5 * edge, count + 1)
    column, row = np.nonzero(np.add.outer(np.arange(count), np.arange(count)) % 2 == 0)
    around = ((0, 0), (1, 0), (1, 1), (0, 1))
    return np.stack([np.column_stack([at[column + x], at[row + y], 0.0 * at[row]]) for x, y in around], axis=1)
