"""Meshes of the page: simplified, sent, checked, and drawn on their objects."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import paper_mapping
from helpers import meshes

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.surface_meshes import decode_mesh
from softfinger.server.viewer.nodes.bodies import SceneStart
from softfinger.server.viewer.page import Page
from softfinger.server.viewer.playback import LoadedRecording, RecordedPage

BEGAN = SceneStart(0, 0, 1e-3, own_clock=False)


def parse_scene(path: Path) -> schema.Scene:
    mapping = paper_mapping(rolling=None)
    part = {"name": "part", "shape": "mesh", "file": str(path), "material": {"stiffness_n_per_m": 500.0}}
    return build(schema.Scene, mapping | {"object": [*mapping["object"], part]}, "test scene")


def write_scan(folder: Path, frequency: int) -> Path:
    return meshes.write_ply(folder / f"ball{frequency}.ply", meshes.geodesic(frequency, 0.04))


@pytest.mark.parametrize(
    ("vertices", "triangles"), [(bytes(13), bytes(12)), (bytes(12), bytes(11)), (bytes(12), b"\x01" + bytes(11))]
)
def test_an_invalid_mesh_is_refused(vertices: bytes, triangles: bytes) -> None:
    with pytest.raises(ValueError, match=r"buffer size|reshape|a triangle has vertex 1, but there are 1"):
        decode_mesh(vertices, triangles)


@pytest.fixture
def page() -> Iterator[Page]:
    with closing(Page("127.0.0.1", 8350)) as page:
        yield page


def find_surfaces(page: Page) -> dict[str, Any]:
    handles = page.server.scene._handle_from_node_name
    return {name: handle for name, handle in handles.items() if name.startswith("/objects/")}


def test_a_recording_shows_its_mesh(page: Page, tmp_path: Path) -> None:
    path = write_scan(tmp_path, 5)
    records = {"": np.zeros((3, RECORD_SIZE))}
    RecordedPage(page, LoadedRecording(records, parse_scene(path), "part", 1000.0, BEGAN), 0)
    drawn = find_surfaces(page)["/objects/1/surface"]
    np.testing.assert_allclose(
        np.abs(drawn.vertices).max(), 100 * 0.04 * np.abs(meshes.geodesic(5).vertices).max(), rtol=1e-6
    )
    assert len(drawn.faces) == 500
    assert drawn.opacity is None, "browsers draw transparent surfaces in an order that hides parts of the shadow"
    missing = parse_scene(tmp_path / "gone.ply")
    page.change(missing, BEGAN)
    assert "/objects/1/surface" not in find_surfaces(page)
    RecordedPage(page, LoadedRecording(records, missing, "part", 1000.0, BEGAN), 0)
    assert "No such file" in page._message.content and "/objects/0/surface" in find_surfaces(page)
