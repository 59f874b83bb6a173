"""Height maps of a scene file: search path, description, errors and display."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.refusals import refusal

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_scene
from softfinger.proxy.meshes.thinning import PICTURE_TRIANGLES
from softfinger.proxy.pictures import MAP_PIXELS, make_picture
from softfinger.proxy.scene import build_scene
from softfinger.server.recording.picture import draw_object
from softfinger.server.verbs.check import examine_file

pytestmark = pytest.mark.plain

HEIGHTS = np.add.outer(np.arange(30) * 1e-4, np.arange(40) * 2e-4)

SCENE = """
[fingertip]
radius_m = 0.01
[[object]]
name = "hill"
shape = "heightmap"
file = "hill.npy"
pitch_m = 0.002
level_m = 0.5
material = { stiffness_n_per_m = 1000.0 }
"""


def scene_file(folder: Path, heights: Any = HEIGHTS, text: str = SCENE) -> Path:
    np.save(folder / "hill.npy", heights)
    file = folder / "scene.toml"
    file.write_text(text, "utf-8")
    return file


def map_refusal(folder: Path, heights: Any, text: str = SCENE) -> str:
    return refusal(lambda: build_scene(load_scene(scene_file(folder, heights, text))))


def test_a_map_file_is_relative_to_its_scene(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path))
    (heightmap,) = scene.object
    assert isinstance(heightmap, schema.Heightmap) and Path(heightmap.file) == tmp_path / "hill.npy"
    assert build(schema.Scene, describe(scene), "again") == scene


def test_check_prints_size_and_heights(tmp_path: Path) -> None:
    rows = dict(examine_file(str(scene_file(tmp_path))).summary)
    assert rows["  map"] == "40 x 30 pixels, 0.08 x 0.06 m, heights 0 to 0.00535 m"
    bowl = np.square(np.arange(-20, 21) * 0.002) / 0.05  # z = x^2 / (2 R) with R = 50 mm, level_m = 0.5
    bends = dict(examine_file(str(scene_file(tmp_path, bowl[None]))).summary)["    bends"]
    assert 0.03 < float(bends.split()[3]) <= 0.05


@pytest.mark.parametrize(
    ("heights", "reason"),
    [
        (np.array([[0.0, 1.0], [np.nan, 0.0]]), "row 1, column 0: nan: must be finite"),
        (np.array([[0.0, -4000.0]]), "a height of -2000 m with level_m = 0.5, at most 1000 m up or down is allowed"),
    ],
)
def test_an_invalid_map_is_reported(tmp_path: Path, heights: Any, reason: str) -> None:
    message = map_refusal(tmp_path, heights)
    assert message.startswith(f"object 'hill': file: {tmp_path / 'hill.npy'}: ") and reason in message
    assert examine_file(str(tmp_path / "scene.toml")).errors == [message]


def test_unreadable_map_files_are_reported(tmp_path: Path) -> None:
    missing = map_refusal(tmp_path, HEIGHTS, SCENE.replace("hill.npy", "hole.npy"))
    assert missing == f"object 'hill': file: {tmp_path / 'hole.npy'}: cannot be read: No such file or directory"
    file = scene_file(tmp_path)
    (tmp_path / "hill.npy").write_bytes((tmp_path / "hill.npy").read_bytes()[:528])
    assert "hill.npy: Failed to read all data" in refusal(lambda: build_scene(load_scene(file)))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("pitch_m = 0.002", "pitch_m = 1e-7", "object[0].pitch_m = 1e-07: must be a number from 1e-06 to 10 m"),
        ("level_m = 0.5", "level_m = 0.0", "object[0].level_m = 0.0: must be a number from 1e-12 to 1000 m"),
        ("level_m = 0.5", "", "object[0].level_m is missing"),
        ("level_m = 0.5", "level_m = 1.0\ninside = true", "object[0].inside is not a key here"),
        ("radius_m = 0.01", "radii_m = [0.01, 0.01, 0.02]", "object[0].shape = 'heightmap': cannot be touch"),
    ],
)
def test_keys_have_ranges(tmp_path: Path, old: str, new: str, reason: str) -> None:
    assert reason in map_refusal(tmp_path, HEIGHTS, SCENE.replace(old, new))


def test_an_unsupported_rolling_method_is_refused_on_a_map(tmp_path: Path) -> None:
    friction = "= 1000.0, friction = { static = 0.6, kinetic = 0.5 } }"
    closed = SCENE.replace("= 1000.0 }", friction) + '[rolling]\nmethod = "rotation_vector"\n'
    assert "no closed form for the heightmap" in map_refusal(tmp_path, HEIGHTS, closed)


def test_pictures_show_the_map(tmp_path: Path) -> None:
    heightmap: Any = load_scene(scene_file(tmp_path)).object[0]
    (vertices, faces), of = make_picture(heightmap)
    np.testing.assert_allclose(vertices[:, 2].reshape(30, 40), 0.5 * HEIGHTS, atol=1e-15)
    np.testing.assert_allclose(np.ptp(vertices, axis=0)[:2], [0.078, 0.058], atol=1e-12)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all() and len(faces) == of == 2 * 29 * 39
    (triangles,) = draw_object(heightmap)["triangles"]
    assert len(triangles["points"]) == HEIGHTS.size and max(triangles["indices"]) == HEIGHTS.size - 1
    scene_file(tmp_path, np.zeros((900, 300)))
    (vertices, faces), of = make_picture(heightmap)
    assert len(vertices) == MAP_PIXELS**2 and len(faces) <= PICTURE_TRIANGLES and of == 2 * 899 * 299
    np.testing.assert_allclose(np.ptp(vertices, axis=0)[:2], [0.598, 1.798], atol=1e-12)
    (tmp_path / "hill.npy").unlink()
    assert "texts" in draw_object(heightmap)
    with pytest.raises(ConfigError, match=r"object 'hill': file: .*hill\.npy: cannot be read"):
        make_picture(heightmap)


@pytest.mark.parametrize("heights", [HEIGHTS[:1], HEIGHTS[:, :1]])
def test_a_profile_is_shown_as_deep_as_it_is_wide(tmp_path: Path, heights: Any) -> None:
    """It is infinite along the other axis, and a single row would have no triangle."""
    (vertices, faces), of = make_picture(load_scene(scene_file(tmp_path, heights)).object[0])
    width, depth = np.ptp(vertices, axis=0)[:2]
    assert width == depth == pytest.approx(0.002 * (heights.size - 1)) and len(faces) == of == 2 * (heights.size - 1)
