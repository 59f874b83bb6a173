"""Arrays named by a scene: equal numbers from every format; height maps: search path, description, errors, display."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.refusals import refusal
from PIL import Image

from softfinger.config import limits, schema
from softfinger.config.arrays.grids import read_grid
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_scene
from softfinger.proxy.meshes.thinning import PICTURE_TRIANGLES
from softfinger.proxy.pictures import MAP_PIXELS, make_picture
from softfinger.proxy.scene import build_scene
from softfinger.server.recording.picture import draw_object
from softfinger.server.verbs.check import examine_file

pytestmark = pytest.mark.plain

GRID = np.array([[0.0, 255.0, 7.0], [128.0, 1.0, 64.0]])


def pgm(head: str, *values: int, wide: bool = False) -> bytes:
    return head.encode() + np.array(values, ">u2" if wide else np.uint8).tobytes()


def npz(path: Path, **arrays: object) -> bytes:
    file = path / "made.npz"
    np.savez_compressed(file, **arrays)
    return file.read_bytes()


def npy(path: Path, array: object) -> bytes:
    file = path / "made.npy"
    np.save(file, array)
    return file.read_bytes()


def read(path: Path, name: str, data: bytes) -> np.ndarray:
    file = path / name
    file.write_bytes(data)
    return read_grid(file)


def test_every_format_gives_the_same_numbers(tmp_path: Path) -> None:
    flat = [int(value) for value in GRID.ravel()]
    files = {
        "a.npy": npy(tmp_path, GRID),
        "b.npy": npy(tmp_path, np.asfortranarray(GRID.astype(np.uint8))),
        "c.npz": npz(tmp_path, heights=GRID.astype(np.int16)),
        "d.csv": b"# by hand\n0, 255, 7\n\n128, 1.0, 6.4e1\n",
        "e.CSV": "\ufeff0,255,7\r\n128,1,64\r\n".encode(),
        "f.pgm": pgm("P5 3 2 255\n", *flat),
        "g.pgm": pgm("P5\n# drawn by hand # and brush\n#\n3 # columns\n2\n255\n", *flat),
        "h.pgm": pgm("P5\n3 2\n65535\n", *flat, wide=True),
    }
    for name, data in files.items():
        np.testing.assert_array_equal(read(tmp_path, name, data), GRID, err_msg=name)
    np.testing.assert_array_equal(read(tmp_path, "i.npy", npy(tmp_path, GRID[0])), GRID[:1])
    # A first value that is white space to a parser of text belongs to the picture.
    np.testing.assert_array_equal(read(tmp_path, "j.pgm", pgm("P5 2 1 255\n", 10, 32)), [[10.0, 32.0]])


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("a.jpg", b"\xff\xd8", "must be one of .npy, .npz, .csv, .pgm, .png: save a picture as grey .png"),
        ("a.png", b"\x89PNG", "a.png: is not a PNG picture"),
        ("a.csv", b"7\n", "has a single value: must have at least two"),
        ("a", b"", "must be one of .npy"),
        ("a.csv", b"# nothing\n", "has no numbers: write one row per line"),
        ("a.csv", b"1,2\n3\n", "line 2 has 1 numbers, the first row 2"),
        ("a.csv", b"1,2\n3,x\n", "line 2: '3,x': must be numbers with points, and commas between them"),
        ("a.csv", b"1.0;2.0\n" * 2, "line 1: '1.0;2.0': must be numbers with points, and commas"),
        ("a.csv", b"1,inf\n", "row 0, column 1: inf: must be finite"),
        ("a.csv", b"1,2\n1e200,4\n", "row 1, column 0: 1e+200: must be finite and at most 1e100"),
        ("a.csv", b"5,5\n5,5\n", "every value is 5: a texture has at least two"),
        ("a.csv", b"\xff\xfe", "codec can't decode byte"),
        ("a.pgm", b"P2 2 1 255\n1 2", "is not a binary grey picture (P5): export it as raw PGM"),
        ("a.pgm", b"P5" + b" #" * 4000, "is not a binary grey picture"),
        ("a.pgm", b"P5 2 2 255\nabc", "has 3 bytes of pixel data: 2 x 2 need 4"),
        ("a.pgm", b"P5 2 2 255\nabcde", "has 5 bytes of pixel data: 2 x 2 need 4"),
        ("a.pgm", b"P5 9999999 9999999 255\nabc", "has 3 bytes of pixel data: 9999999 x 9999999 need"),
        ("a.pgm", b"P5 1 1 0\na", "gives 0: must be 1 to 65535"),
        ("a.npy", b"no array", "magic string is not correct"),
        ("a.npz", b"no archive", "is not an archive of arrays"),
        ("a.npy", np.zeros((2, 2, 3)), "an array of shape (2, 2, 3): must have rows and columns; select one channel"),
        ("a.npy", np.zeros((0, 3)), "an array of shape (0, 3)"),
        ("a.npy", np.array(1.0), "an array of shape ()"),
        ("a.npy", np.array([["1", "2"]]), "contains <U1, must contain numbers"),
        ("a.npy", np.array([[1.0, 2.0j]]), "contains complex128, must contain numbers"),
        ("a.npy", np.array([[None, 1]]), "Object arrays cannot be loaded"),
        ("a.npy", np.zeros((1025, 1024), bool), "has 1,049,600 values, at most 1,048,576 are allowed: 1024 by 1024"),
        ("a.png", np.zeros((2, 3, 3), np.uint8), "has pixels of RGB, must be grey without transparency"),
        ("a.png", np.zeros((2, 3, 4), np.uint8), "has pixels of RGBA, must be grey"),
        ("a.png", np.zeros((1, 1), np.uint8), "has a single value"),
        ("a.png", np.zeros((1025, 1024), np.uint8), "has 1024 x 1025 pixels, at most 1,048,576 are allowed"),
    ],
)
def test_an_invalid_grid_is_reported(tmp_path: Path, name: str, data: Any, reason: str) -> None:
    if isinstance(data, np.ndarray):
        data = png(data) if name == "a.png" else npy(tmp_path, data)
    message = refusal(read, tmp_path, name, data)
    assert message.startswith(f"{tmp_path / name}: ") and reason in message


def png(picture: np.ndarray, **how: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", **how)
    return file.getvalue()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_grey_pictures_keep_their_levels(tmp_path: Path, kind: type) -> None:
    levels = np.array([[0, 1, 2], [3, 128, np.iinfo(kind).max]], kind)
    np.testing.assert_array_equal(read(tmp_path, "a.png", png(levels)), levels)
    np.testing.assert_array_equal(read(tmp_path, "B.PNG", png(levels, optimize=True)), levels)


def test_archive_of_several_arrays_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has the arrays a, b: must have one; save only that one"):
        read(tmp_path, "a.npz", npz(tmp_path, a=GRID, b=GRID))


def test_claims_of_a_header_make_no_room(tmp_path: Path) -> None:
    header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 1)}
    with (tmp_path / "vast.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(ConfigError, match=r"Unable to allocate|could only read"):
        read_grid(tmp_path / "vast.npy")
    bomb = npz(tmp_path, a=np.zeros((4 * int(limits.GRID_VALUES.high)), np.uint8))
    assert len(bomb) < 1 << 20
    with pytest.raises(ConfigError, match="are allowed"):
        read(tmp_path, "bomb.npz", bomb)


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
