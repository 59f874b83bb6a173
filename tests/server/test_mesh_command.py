"""Command `mesh` over a real socket: triangles of a mesh and of a height map, and refused objects.

The daemon's command service answers without a loop, because a loop for these shapes takes a minute to compile.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers import meshes
from helpers.pages import LOCAL
from helpers.waits import WAIT_S

from softfinger.config import schema
from softfinger.config.errors import CommandRefused
from softfinger.config.load import build, load_rig
from softfinger.server.services.commands import CommandService
from softfinger.server.wire.commands import MeshResult
from softfinger.server.wire.control import AsyncControl, Control
from softfinger.server.wire.publisher import Publisher
from softfinger.server.wire.rig_endpoints import bind_rig

MATERIAL = {"stiffness_n_per_m": 500.0}
BALL = meshes.geodesic(16, 0.04)
"""5120 triangles."""
HEIGHTS = 1e-3 * np.sin(np.add.outer(np.arange(20.0), 2.0 * np.arange(30.0)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("files")
    meshes.write_ply(folder / "ball.ply", BALL)
    np.save(folder / "hills.npy", HEIGHTS)
    np.save(folder / "large.npy", np.zeros((1000, 1000)))
    return folder


def make_scene(*objects: dict[str, Any]) -> schema.Scene:
    mapping = {"fingertip": {"radius_m": 0.01}, "object": [table | {"material": MATERIAL} for table in objects]}
    return build(schema.Scene, mapping, "test scene")


@pytest.fixture(scope="module")
def commands(folder: Path) -> Iterator[str]:
    scene = make_scene(
        {"name": "ball", "shape": "mesh", "file": str(folder / "ball.ply")},
        {"name": "hills", "shape": "heightmap", "file": str(folder / "hills.npy"), "pitch_m": 0.001, "level_m": 1.0},
        {"name": "large", "shape": "heightmap", "file": str(folder / "large.npy"), "pitch_m": 0.001, "level_m": 1.0},
        {"name": "table", "shape": "plane"},
    )
    force = SimpleNamespace(is_reachable=True, note_guard=lambda reason, is_off: None)
    rendering = cast(Any, SimpleNamespace(rig=load_rig("replay", LOCAL), scene=scene, force=force))
    doors = bind_rig(rendering.rig)
    with Publisher(doors) as publisher:
        actions = cast(Any, SimpleNamespace(replace=None, publisher=publisher))
        service = CommandService(str(doors.commands), rendering, actions, "meshes")
        service.start()
        yield str(doors.commands)
        service.stop()


@pytest.fixture
def control(commands: str) -> Iterator[Control]:
    with Control(commands, timeout_s=WAIT_S) as control:
        yield control


def arrays(sent: MeshResult) -> tuple[np.ndarray, np.ndarray]:
    vertices, triangles = np.frombuffer(sent.vertices, "<f4"), np.frombuffer(sent.triangles, "<u4")
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)


def test_a_mesh_has_the_triangles_of_its_file(control: Control, commands: str) -> None:
    async def ask() -> MeshResult:
        async with AsyncControl(commands, timeout_s=WAIT_S) as control:
            return await control.mesh("ball")

    sent = control.mesh("ball")
    assert sent == control.mesh(0) == asyncio.run(ask()) and sent.of == len(BALL.triangles) == 5120
    vertices, triangles = arrays(sent)
    corners, expected = vertices[triangles], BALL.vertices.astype("<f4")[BALL.triangles]
    np.testing.assert_array_equal(order(corners), order(expected))


def order(corners: np.ndarray) -> np.ndarray:
    rows = np.sort(corners.reshape(len(corners), -1), axis=1)
    return rows[np.lexsort(rows.T)]


def test_a_height_map_has_a_vertex_for_each_pixel(control: Control) -> None:
    sent = control.mesh("hills")
    vertices, triangles = arrays(sent)
    np.testing.assert_allclose(vertices[:, 2].reshape(HEIGHTS.shape), HEIGHTS, atol=1e-9)  # float32 of 1 mm
    np.testing.assert_allclose(vertices[:, :2].min(axis=0), [-0.0145, -0.0095], rtol=1e-6)
    assert len(triangles) == sent.of == 2 * 19 * 29 and triangles.max() == HEIGHTS.size - 1


def test_a_large_height_map_is_reduced(control: Control) -> None:
    sent = control.mesh("large")
    vertices, triangles = arrays(sent)
    assert len(triangles) <= 50_000 < sent.of == 2 * 999 * 999
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [0.999, 0.999, 0.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("object_name", "message"),
    [
        (4, "bad_params: there is no object 4; objects are ball, hills, large, table"),
        ("cube", "bad_params: there is no object 'cube'; objects are ball, hills, large, table"),
        (-1, "bad_params: mesh: object: Expected `int` >= 0; parameters are object: text or integer"),
        ("table", "refused: object table is a plane and no mesh: its table describes it completely"),
    ],
)
def test_objects_without_triangles_are_refused(control: Control, object_name: int | str, message: str) -> None:
    with pytest.raises(CommandRefused) as caught:
        control.mesh(object_name)
    assert str(caught.value) == message


def test_a_map_with_a_missing_file_is_refused(control: Control, folder: Path) -> None:
    """A height map is read again for each request; a mesh is in memory."""
    (folder / "hills.npy").unlink()
    (folder / "ball.ply").unlink()
    with pytest.raises(CommandRefused, match=r"^bad_params: object 'hills': file: .*hills\.npy: cannot be read: .*$"):
        control.mesh("hills")
    assert control.mesh("ball").of == 5120
