"""Limits of configuration files: bounded time and memory, and no ignored override."""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.waits import ends_within

from softfinger.config.errors import ConfigError
from softfinger.config.load import FaultyConfig, load_rig, load_scene
from softfinger.config.sources import DEPTH_MAX, PARTS_MAX, parse_toml, read_toml
from softfinger.server.verbs.check import examine_file

pytestmark = pytest.mark.plain

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


def test_an_override_of_a_rig_without_a_place_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('[device]\ndriver = "replay"\nrecording = "tap"\n')
    with pytest.raises(ConfigError, match=r"flag: device\.recording\.name: .* in 'tap', which is not a table"):
        load_rig(path, {"device.recording.name": "x"}, {"device.recording.name": "flag"})


def test_check_of_a_rig_reads_its_recording(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    (tmp_path / "bad.csv").write_text("t,x\n")
    for recording, message in (("missing.csv", "no such file"), (str(tmp_path / "bad.csv"), "line 1")):
        path.write_text(f'[device]\ndriver = "replay"\nrecording = "{recording}"\n')
        (error,) = examine_file(str(path)).errors
        assert "rig.toml: device.recording" in error and message in error
    path.write_text('[devices.thumb]\ndriver = "replay"\nrecording = "missing.csv"\n')
    assert "devices.thumb.recording" in examine_file(str(path)).errors[0]
    path.write_text('[device]\ndriver = "replay"\nrecording = "tap"\n')
    assert not examine_file(str(path)).errors
