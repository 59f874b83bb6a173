"""Arrays named by a scene: every format gives the same numbers; other files give one clear error."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.refusals import refusal
from PIL import Image

from softfinger.config import limits
from softfinger.config.arrays.grids import read_grid
from softfinger.config.errors import ConfigError

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
        ("a.png", b"\x89PNG", "cannot identify image file"),
        ("a.csv", b"7\n", "has a single value: must have at least two"),
        ("a", b"", "must be one of .npy"),
        ("a.csv", b"# nothing\n", "has no numbers: write one row per line"),
        ("a.csv", b"1,2\n3\n", "line 2 has 1 numbers, the first row 2"),
        ("a.csv", b"1,2\n3,x\n", "line 2: could not convert string to float: 'x'"),
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
