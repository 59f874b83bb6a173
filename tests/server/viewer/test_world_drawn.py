"""Bodies of a [world] on the page: with and without contacts."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from softfinger.config.load import load_scene
from softfinger.server.viewer.nodes.bodies import BodyNodes, SceneStart, list_visual_geoms

viser = pytest.importorskip("viser")
pytestmark = pytest.mark.plain


def test_boxes_without_contacts_are_drawn_at_their_poses() -> None:
    scene = load_scene("stack-boxes")
    assert [element.name for element in scene.object] == ["floor", "top"]
    assert [element.name for element in list_visual_geoms(scene)] == ["bottom", "middle"]
    server = viser.ViserServer(port=0, verbose=False)
    try:
        bodies = BodyNodes(server.scene, scene, SceneStart(0, 0, 1e-3, True))
        upright = (1.0, 0.0, 0.0, 0.0)
        bodies.move_bodies(dict.fromkeys(("bottom", "middle"), ((0.0, 0.1, 0.2), upright)))
        assert [place[0] for place in bodies.poses[2:]] == [(0.0, 0.1, 0.2)] * 2
        for point, height in (((0.1, 0.0, 0.1), 0.0), ((0.0, 0.1, 0.3), 0.215)):  # next to them, and on one of 30 mm
            foot = bodies.below(np.array(point))
            assert foot is not None and foot.point.tolist() == pytest.approx([*point[:2], height])
    finally:
        server.stop()


def test_a_missing_model_draws_no_more_bodies() -> None:
    """The model may be missing if the daemon runs on another machine."""
    scene = load_scene("stack-boxes")
    assert scene.world is not None
    elsewhere = msgspec.structs.replace(scene.world, model="/no/such/place.xml")
    assert list_visual_geoms(msgspec.structs.replace(scene, world=elsewhere)) == []
