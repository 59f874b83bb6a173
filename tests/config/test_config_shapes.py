"""Shapes and values of a scene: accepted and normalised values, refused values, the bodies of each shape; limits of
configuration files: bounded time and memory, and no ignored override."""

import math
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from helpers.refusals import faults_in
from helpers.waits import ends_within

from softfinger import Engine
from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import FaultyConfig, build, describe, load_rig, load_scene
from softfinger.config.schema import Tool
from softfinger.config.sources import DEPTH_MAX, PARTS_MAX, parse_toml, read_toml
from softfinger.drivers.mounting import Mounting
from softfinger.proxy.kernels.shapes import closest
from softfinger.proxy.scene import shape_bodies
from softfinger.server.wire.envelope import DeclinedRequest, parse

pytestmark = pytest.mark.plain

SHAPES: dict[str, dict[str, Any]] = {
    "plane": {},
    "sphere": {"radius_m": 0.05},
    "cylinder": {"radius_m": 0.05, "length_m": 0.2},
    "capsule": {"radius_m": 0.05, "length_m": 0.2},
    "box": {"size_m": [0.1, 0.2, 0.3]},
    "ellipsoid": {"semi_axes_m": [0.06, 0.05, 0.04]},
    "torus": {"major_radius_m": 0.06, "minor_radius_m": 0.02},
    "mesh": {"file": "part.PLY"},
}
UNSIZED = ("plane", "mesh")
"""Shapes whose tables have no length."""

FROM_FILES = {"heightmap"}
"""Shapes with dimensions in a file, tested in test_grids."""


def mapping(shape: str, fingertip: float = 0.01, **keys: Any) -> dict[str, Any]:
    """Return a scene of one object of that shape, in the layout of a file; None removes a key."""
    entry = {"name": "thing", "shape": shape, "material": {"stiffness_n_per_m": 1000.0}, **SHAPES[shape], **keys}
    entry = {key: value for key, value in entry.items() if value is not None}
    return {"fingertip": {"radius_m": fingertip}, "object": [entry]}


def object_of(shape: str, fingertip: float = 0.01, **keys: Any) -> Any:
    (item,) = build(schema.Scene, mapping(shape, fingertip, **keys), "f.toml").object
    return item


def faults_of(shape: str, fingertip: float = 0.01, **keys: Any) -> list[str]:
    return [str(fault) for fault in faults_in(build, schema.Scene, mapping(shape, fingertip, **keys), "f.toml")]


def signed_distance(item: Any, x: tuple[float, float, float]) -> float:
    """Gap to the nearest of an object's bodies, m."""
    return min(float(closest(shape, x)[0]) for shape, _, _ in shape_bodies(item))


@pytest.mark.parametrize("shape", [kind.shape for kind in schema.Object.__args__ if kind.shape not in FROM_FILES])
def test_the_key_shape_selects_the_struct(shape: str) -> None:
    scene = build(schema.Scene, mapping(shape), "f.toml")
    assert scene.object[0].shape == shape == type(scene.object[0]).__name__.lower()
    assert build(schema.Scene, describe(scene), "again") == scene


def keys_of_size(shape: str, size: float) -> dict[str, Any]:
    """Every dimension of a shape at that size; the ring of a torus wide enough for a hole, within the range."""
    if shape == "torus":
        return {"major_radius_m": min(3.0 * size, limits.LENGTH_M.high), "minor_radius_m": min(size, 300.0)}
    return {key: [size] * 3 if isinstance(value, list) else size for key, value in SHAPES[shape].items()}


@pytest.mark.parametrize("shape", [name for name in SHAPES if name not in UNSIZED])
def test_dimensions_have_the_range_the_geometry_is_tested_in(shape: str) -> None:
    low, high, _ = limits.LENGTH_M
    for size in (low, high):
        assert object_of(shape, low, **keys_of_size(shape, size)).shape == shape
    for key, value in SHAPES[shape].items():
        for beyond in (low * 0.99, high * 1.01):
            faults = faults_of(shape, **{key: [beyond] * 3 if isinstance(value, list) else beyond})
            assert any(f"object[0].{key}" in fault and "from 1e-05 to 1000 m" in fault for fault in faults)


@pytest.mark.parametrize(
    ("shape", "key"), [(s, k) for s, keys in SHAPES.items() for k in keys if (s, k) != ("cylinder", "length_m")]
)
def test_dimensions_are_required(shape: str, key: str) -> None:
    (fault,) = faults_of(shape, **{key: None})
    assert f"object[0].{key} is missing" in fault and f"such as {key} = " in fault


TIGHT: list[tuple[str, float, dict[str, Any], str]] = [
    ("sphere", 0.05, {"inside": True}, "radius_m"),
    ("cylinder", 0.05, {"inside": True}, "radius_m"),
    ("cylinder", 0.01, {"inside": True, "length_m": 0.02}, "length_m"),
    ("capsule", 0.05, {"inside": True}, "radius_m"),
    ("box", 0.05, {"inside": True}, "size_m"),
    ("ellipsoid", 0.04 * 0.04 / 0.06, {"inside": True}, "semi_axes_m"),
    ("torus", 0.02, {"inside": True}, "minor_radius_m"),
    ("torus", 0.06 - 0.02, {}, "major_radius_m"),
]


@pytest.mark.parametrize(("shape", "radius", "keys", "at"), TIGHT)
def test_a_fingertip_must_fit(shape: str, radius: float, keys: dict[str, Any], at: str) -> None:
    (fault,) = faults_of(shape, radius * 1.0001, **keys)
    assert f"object[0].{at} = " in fault and "fingertip" in fault
    assert f"{radius * 1.0001:g} m" in fault or f"{2 * radius * 1.0001:g} m" in fault
    assert object_of(shape, radius * 0.999, **keys).shape == shape


@pytest.mark.parametrize("shape", [name for name in SHAPES if name not in {"plane", "torus"}])
def test_outside_any_fingertip_fits(shape: str) -> None:
    assert object_of(shape, limits.LENGTH_M.high).shape == shape


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"file": "part.step"}, "object[0].file = 'part.step': must end in .ply, .stl, .obj, .glb"),
        ({"file": ""}, "object[0].file = '': must be text of 1 to 4096 characters"),
        ({"scale": 0.0}, "object[0].scale = 0.0: must be a number from 1e-09 to 1e+09"),
        ({"scale": -1.0}, "object[0].scale = -1.0: must be a number from 1e-09 to 1e+09"),
        ({"shading": "phong"}, "object[0].shading = 'phong': must be one of 'none', 'normals'"),
        ({"inside": 1}, "object[0].inside = 1: must be true or false"),
        ({"size_m": 1.0}, "object[0].size_m"),
    ],
)
def test_faults_of_a_mesh_are_reported(keys: dict[str, Any], text: str) -> None:
    (fault,) = faults_of("mesh", **keys)
    assert text in fault


def test_faults_of_pose_and_shape_are_reported_together() -> None:
    ring, turn = sorted(faults_of("torus", minor_radius_m=0.06, orientation_wxyz=[0, 0, 0, 0]))
    assert "object[0].minor_radius_m = 0.06: must be below major_radius_m = 0.06 m" in ring
    assert turn.startswith("f.toml: object[0].orientation_wxyz = ")


@pytest.mark.parametrize(
    ("shape", "keys", "x", "gap"),
    [
        ("plane", {}, (0.3, 0.2, 0.1), 0.1),
        ("sphere", {}, (0.0, 0.06, 0.0), 0.01),
        ("sphere", {"inside": True}, (0.0, 0.04, 0.0), 0.01),
        ("cylinder", {}, (0.0, 0.0, 0.13), 0.03),
        ("cylinder", {}, (0.08, 0.0, 0.14), 0.05),
        ("cylinder", {"inside": True}, (0.0, 0.01, 0.08), 0.02),
        ("cylinder", {"inside": True}, (0.0, 0.04, 0.0), 0.01),
        ("cylinder", {"inside": True}, (0.0, 0.0, -0.13), -0.03),
        ("capsule", {}, (0.0, 0.0, 0.17), 0.02),
        ("capsule", {"inside": True}, (0.0, 0.03, 0.0), 0.02),
        ("box", {}, (0.08, 0.14, 0.0), 0.05),
        ("box", {"inside": True}, (0.04, 0.0, 0.0), 0.01),
        ("box", {"inside": True}, (0.0, -0.09, 0.0), 0.01),
        ("box", {"inside": True}, (0.0, 0.0, 0.16), -0.01),
        ("ellipsoid", {}, (0.0, 0.0, -0.05), 0.01),
        ("torus", {}, (0.0, 0.06, 0.03), 0.01),
        ("torus", {"inside": True}, (0.0, 0.06, 0.005), 0.015),
    ],
)
def test_distances_of_bodies_equal_the_dimensions_in_the_file(shape, keys, x, gap):
    # 1e-16: rounding of lengths below a third of a metre.
    assert signed_distance(object_of(shape, **keys), x) == pytest.approx(gap, abs=1e-16)


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_the_walls_of_a_hollow_enclose_the_volume_of_the_solid(shape: str) -> None:
    solid, hollow = object_of(shape), object_of(shape, inside=True)
    points = np.random.default_rng(5).uniform(-0.16, 0.16, (1000, 3))
    inner = 0
    for x in map(tuple, points.tolist()):
        within, room = signed_distance(solid, x), signed_distance(hollow, x)
        assert (within < 0.0) == (room > 0.0)
        if within < 0.0:
            assert room == pytest.approx(-within, abs=1e-16)
            inner += 1
    assert 50 < inner < 950


POSITION, STIFFNESS = "object.table.position_m", "object.table.material.stiffness_n_per_m"
VALUES = [
    (POSITION, np.array([0.0, 0.0, 0.5]), [0.0, 0.0, 0.5]),
    (POSITION, np.array([0, 0, 1]), [0.0, 0.0, 1.0]),
    (POSITION, [np.float64(0.0), np.int32(0), np.float32(0.5)], [0.0, 0.0, 0.5]),
    (STIFFNESS, np.float32(500.0), 500.0),
    (STIFFNESS, np.int64(500), 500.0),
    (STIFFNESS, np.array(500.0), 500.0),
]


@pytest.mark.parametrize(("key", "value", "plain"), VALUES)
def test_values_of_numpy_are_plain_values(key: str, value: Any, plain: Any) -> None:
    assert load_scene("paper-plane", {key: value}) == load_scene("paper-plane", {key: plain})
    engine = Engine("paper-plane")
    engine.set(key, value)
    assert engine.get(key) == plain


def test_a_mapping_may_contain_arrays() -> None:
    table = {"name": "table", "shape": "plane", "position_m": np.zeros(3)}
    material = {"stiffness_n_per_m": np.int64(800)}
    scene = {"fingertip": {"radius_m": np.float32(0.5)}, "object": [table | {"material": material}]}
    assert load_scene(scene).object[0].material.stiffness_n_per_m == 800.0


@pytest.mark.parametrize("value", [np.zeros(2), np.full(3, np.nan), np.zeros((3, 3)), np.array(["x", "y", "z"])])
def test_an_unusable_array_is_a_fault(value: Any) -> None:
    with pytest.raises(ConfigError, match=r"object\[0\]\.position_m"):
        load_scene("paper-plane", {POSITION: value})


DIRECTION = (0.5, -0.5, 0.5, 0.5)
LENGTHS = [1e-310, 1e-200, 1e-160, 1.0, 1e3]
"""The squares of the first two are zero, and that of the third has lost most of its digits."""


def led(orientation: Sequence[float]) -> Any:
    params = {"position_m": [0.0, 0.0, 0.02], "orientation_wxyz": list(orientation)}
    return parse(msgpack.packb({"command_id": "1", "method": "hand", "params": params})).params.orientation_wxyz


def of_object(orientation: Sequence[float]) -> Any:
    return load_scene("paper-plane", {"object.0.orientation_wxyz": list(orientation)}).object[0].orientation_wxyz


PLACES: dict[str, Callable[[Sequence[float]], Any]] = {
    "object": of_object,
    "tool": lambda q: build(Tool, {"orientation_wxyz": list(q)}, "rig").orientation_wxyz,
    "mounting": lambda q: build(Mounting, {"orientation_wxyz": list(q)}, "rig").frame()[1],
    "hand": led,
}


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("place", PLACES)
def test_only_the_direction_counts(place: str, length: float) -> None:
    # Numbers of 1e-310 have 13 digits.
    assert PLACES[place]([length * part for part in DIRECTION]) == pytest.approx(DIRECTION, abs=1e-12)


@pytest.mark.parametrize("part", [math.inf, -math.inf, math.nan, 1e308])
def test_a_hand_does_not_turn_to_no_direction(part: float) -> None:
    with pytest.raises(DeclinedRequest, match=r"^bad_params: "):
        led((part, part, part, part))


SIZE = 1_000_000
"""Just below the largest file that is read."""
LATE_S = 120
"""Each of these takes a few seconds at most; an unbounded case takes an hour."""


@pytest.fixture(autouse=True)
def _no_waiting() -> Iterator[None]:
    with ends_within(LATE_S):
        yield


def repeat(part: str) -> str:
    return part * (SIZE // len(part))


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "text",
    [
        repeat("a.") + "a = 1",
        repeat('"a" . ') + "a = 1",
        repeat("'a'.") + "a = 1",
        "[" + repeat("a.") + "a]",
        "[[" + repeat("a\t.") + "a]]",
        "b = { " + repeat("a.") + "a = 1 }",
        "b = [{ c = '''\n''', " + repeat("a.") + "a = 1 }]",
    ],
    ids=["bare", "quoted", "literal", "table", "array of tables", "inline", "after a string"],
)
def test_keys_without_end_are_refused(tmp_path: Path, text: str) -> None:
    """tomllib's time and memory grow with the square of a key's parts, so a long key is refused before parsing."""
    path = tmp_path / "long.toml"
    path.write_text("# first\n" + text)
    with pytest.raises(ConfigError, match=rf"long\.toml, line [23]: a key of more than {PARTS_MAX} parts"):
        read_toml(path)


def test_the_longest_key_is_read() -> None:
    longest = ".".join(["a"] * PARTS_MAX)
    assert parse_toml(f"{longest} = 1", "t") == tomllib.loads(f"{longest} = 1")
    with pytest.raises(ConfigError, match="parts"):
        parse_toml(f"{longest}.a = 1", "t")


@pytest.mark.parametrize(
    "text",
    [
        "# " + "a." * 100,
        "k = 1 # it's " + "a." * 100,
        "k = '" + "a." * 100 + "'",
        'k = "\\" ' + "a." * 100 + '"',
        'k = """\n' + "a." * 100 + '\n"x" \\""" \n"""',
        "k = '''\n\"\"\" # " + "a." * 100 + "\n'''",
        "k = [" + "1.5, " * 100 + "]",
    ],
)
def test_dots_that_are_in_no_key_are_read(text: str) -> None:
    assert parse_toml(text, "t") == tomllib.loads(text)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("text", [repeat('"""\\'), repeat("'\"#"), repeat("a-") + ".", repeat('\\"'), repeat("' .")])
def test_text_of_broken_strings_takes_no_time(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_toml(text, "t")


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 300 + "]" * 300,
        "a = " + "{ a.a.a.a.a.a.a.a = " * 200 + "1" + "}" * 200,
        "a = " + repeat("["),
        "a = " + repeat("{a="),
        "a = " + "1" * SIZE,
    ],
    ids=["lists", "tables", "brackets", "braces", "digits"],
)
def test_nesting_without_end_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "deep.toml"
    for before, load in (("", load_scene), ('[device]\ndriver = "replay"\n', load_rig)):
        path.write_text(before + text)
        with pytest.raises(ConfigError, match=r"deep\.toml: (tables or lists nested more than|not usable|not TOML)"):
            load(path)


def test_the_deepest_table_is_read() -> None:
    text = "a = " + "[" * (DEPTH_MAX - 1) + "]" * (DEPTH_MAX - 1)
    assert parse_toml(text, "t") == tomllib.loads(text)
    with pytest.raises(ConfigError, match="deep"):
        parse_toml("a = " + "[" * DEPTH_MAX + "]" * DEPTH_MAX, "t")


def test_keys_without_number_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "wide.toml"
    path.write_text("".join(f"k{number} = 1\n" for number in range(80_000)))
    with pytest.raises(FaultyConfig, match=r"79992 more keys") as caught:
        load_scene(path)
    assert len(str(caught.value)) < 4000


def test_a_long_list_of_faults_is_truncated(tmp_path: Path) -> None:
    path = tmp_path / "pasted.toml"
    path.write_text("".join(f'[[object]]\nname = "o{number}"\nshape = "plane"\noops = 1\n' for number in range(80)))
    with pytest.raises(FaultyConfig) as caught:
        load_scene(path)
    first, *lines = str(caught.value).splitlines()
    faults = caught.value.faults
    assert len(faults) >= 80 and first == f"{len(faults)} faults:"
    assert lines[:-1] == [f"  {fault}" for fault in faults[: len(lines) - 1]]
    assert lines[-1] == f"  and {len(faults) - len(lines) + 1} more: correct these first" and len(lines) < 25


@pytest.mark.parametrize("key", ["object.0.material.stiffness_n_per_m", "object[0].material.stiffness_n_per_m"])
def test_an_override_reaches_into_lists(key: str) -> None:
    first, second = load_scene("corner", {key: 500}).object[:2]
    assert first.material.stiffness_n_per_m == 500 and second == load_scene("corner").object[1]
    turned = load_scene("corner", {"object.1.orientation_wxyz.2": -0.7071067811865476})
    assert turned.object[1].orientation_wxyz[2] < 0.0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"object.3.name": "x"}, r"override: object\.3\.name: there is no object\[3\]: entries go from 0 to 2"),
        ({"object.first.name": "x"}, r"no object\.first: .* by name .*; to add an entry, set the complete list object"),
        ({"object.-1.name": "x"}, r"there is no object\.-1"),
        ({"object.name": "x"}, r"there is no object\.name"),
        ({"object.1.orientation_wxyz.4": 0.0}, r"no object\[1\]\.orientation_wxyz\[4\]: .* 0 to 3; .*complete list"),
        ({"object.0.position_m.2": 0.0}, r"override: object\[0\]\.position_m = a table: must be a list of 3"),
        ({"object.0.shape.kind": "x"}, r"object\.0\.shape\.kind: object\[0\]\.shape\.kind would be in 'plane'"),
        ({"fingertip.radius_m.x": 1.0}, r"fingertip\.radius_m\.x: .* would be in 0.01, which is not a table"),
        ({"fingertop.radius_m": 1.0}, r"override: fingertop is not a key here.*fingertip"),
        ({"object.0.matrial.stiffness_n_per_m": 1.0}, r"override: object\[0\]\.matrial is not a key"),
        ({"object[0].material.stiffness_n_per_m": -1.0}, r"override: object\[0\]\.material\.stiffness_n_per_m = -1"),
        ({"object.0.material.stiffness_n_per_m": -1.0}, r"override: object\[0\]\.material\.stiffness_n_per_m = -1"),
    ],
)
def test_an_override_that_has_no_place_is_refused(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_scene("corner", overrides)


@pytest.mark.parametrize("is_linked", [False, True])
def test_files_of_a_linked_scene(is_linked: bool, tmp_path: Path) -> None:
    """They are in the folder of the link, as for other programs, or in that of its target if the link has none."""
    target, link = tmp_path / "target", tmp_path / "link"
    for folder in (target, link):
        folder.mkdir()
    (target / "part.ply").touch()
    (target / "scene.toml").write_text(
        '[fingertip]\nradius_m = 0.01\n[[object]]\nname = "part"\nshape = "mesh"\nfile = "part.ply"\nroot = "."\n'
        "[object.material]\nstiffness_n_per_m = 1000.0\n"
    )
    (link / "scene.toml").symlink_to("../target/scene.toml")
    if is_linked:
        (link / "part.ply").symlink_to("../target/part.ply")
    (part,) = load_scene(link / "scene.toml").object
    assert isinstance(part, schema.Mesh)
    assert (part.file, part.root) == (
        (f"{link}/part.ply", f"{link}") if is_linked else (f"{target}/part.ply", f"{target}")
    )
