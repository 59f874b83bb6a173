"""A plane as a chessboard of which every other square is left out: whatever the light, its colour is the same.

Without a graphics card a page pays for each pixel that is painted, and a plane fills most of the picture.
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
"""The extension of glTF: the page's own materials all reckon with light."""


def add_board(api: Any, node: str, edge: float, count: int, colour: Colour, opacity: float) -> None:
    """A board of `count` squares a side, in the page's units, to be seen from above."""
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
    """Corners (n, 4, 3), counter-clockwise, of every other square of a level board about the origin.

    edge   of the board
    count  of squares a side, those left out too
    """
    at = np.linspace(-0.5 * edge, 0.5 * edge, count + 1)
    column, row = np.nonzero(np.add.outer(np.arange(count), np.arange(count)) % 2 == 0)
    around = ((0, 0), (1, 0), (1, 1), (0, 1))
    return np.stack([np.column_stack([at[column + x], at[row + y], 0.0 * at[row]]) for x, y in around], axis=1)
