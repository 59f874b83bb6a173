"""Elastic object on the page: deformed under a contact, undeformed without one."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softfinger.config.load import load_scene
from softfinger.config.schema import Mesh
from softfinger.proxy.elastic.prepared import prepare_body
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT
from softfinger.server.surface_meshes import SurfaceMesh
from softfinger.server.viewer.nodes.bodies import BodyNodes, SceneStart
from softfinger.server.viewer.nodes.looks import CM

pytestmark = pytest.mark.plain


class Nodes:
    def __init__(self) -> None:
        self.drawn = SimpleNamespace()

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: self.drawn if name == "add_mesh_simple" else SimpleNamespace()


def test_an_elastic_object_returns_to_its_shape() -> None:
    scene, nodes = load_scene("press-a-pad"), Nodes()
    pad = scene.object[0]
    assert isinstance(pad, Mesh)
    surface = prepare_body(pad).surface
    mesh = SurfaceMesh(surface.vertices.astype("<f4").astype(float), surface.triangles.astype(np.uint32))
    still = (CM * mesh.vertices).astype(np.float32)
    poses = np.tile([0.0, 0.0, 0.008, 1.0, 0.0, 0.0, 0.0], (80, 1))  # until the damping has decayed
    poses[-1, 2] = 0.03
    pressed, free = np.asarray(Engine("press-a-pad").run(poses))[-2:]
    displacement = pressed[AT.contact_displacement : AT.contact_displacement + 3]
    assert displacement[2] < -5e-4 and free[AT.contact_mode] == 0.0
    for tick in (0, 5000):
        bodies = BodyNodes(nodes, scene, SceneStart(tick, 0, 1e-3, True))
        bodies.draw(0, mesh)
        for _ in range(2):
            bodies.deform({"": pressed})
            moved = (nodes.drawn.vertices - still) / CM
            lowest = int(moved[:, 2].argmin())
            assert moved[lowest, 2] == pytest.approx(displacement[2], rel=0.2)
            assert (
                np.linalg.norm(mesh.vertices[lowest, :2]) < 0.01 and abs(moved[mesh.vertices[:, 2] < 1e-6]).max() < 1e-8
            )
            bodies.deform({"": free})
            assert (nodes.drawn.vertices == still).all()
