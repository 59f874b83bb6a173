"""`softfinger materials`: the list, an entry with its sources, its figure, and the rows of `check`."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from helpers.called import read_stdout

from softfinger.config.materials import load_fingertips, load_materials, load_papers
from softfinger.proxy.engine import Engine
from softfinger.server.offline import feel_figure
from softfinger.server.offline.library_texts import make_library_table

pytestmark = pytest.mark.plain

SCENE = """
[fingertip]
pad = "human-index"
radius_m = 0.012
[[object]]
name = "a"
shape = "plane"
material = { name = "rubber", stiffness_n_per_m = 900, friction = { kinetic = 0.5 } }
[[object]]
name = "b"
shape = "plane"
material = "wood"
"""


def test_the_list_has_a_line_for_each_entry() -> None:
    lines = [line.split()[:2] for line in read_stdout("materials").splitlines()]
    kinds = {"material": load_materials(), "fingertip": load_fingertips()}
    assert lines == [[name, kind] for kind, entries in kinds.items() for name in entries]
    listed = {load["name"]: load for load in json.loads(read_stdout("materials", "--json"))}
    assert list(listed) == [name for name, _ in lines]
    assert listed["wood"]["values"] == load_materials()["wood"].values
    assert {"friction": 0.61, "sd": 0.21}.items() <= listed["silicone"]["measured"][0].items()


@pytest.mark.parametrize("name", ["rubber", "finger-pad", "human-index"])
def test_an_entry_is_printed_with_its_sources(name: str) -> None:
    out = read_stdout("materials", name)
    entry = {**load_materials(), **load_fingertips()}[name]
    assert entry.holds in out and "N/m" in out if name in load_materials() else "0.01 m" in out
    shown = json.loads(read_stdout("materials", name, "--json"))
    assert set(entry.papers) <= set(shown["papers"])
    for paper in shown["papers"]:
        assert load_papers()[paper].text in out and load_papers()[paper].doi in out


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["aluminium", "finger-pad", "human-index-plateau"])
def test_an_entry_is_drawn(name: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="an extra")
    file = tmp_path / "figure.svg"
    read_stdout("materials", name, "--plot", str(file))
    text = " ".join(ET.fromstring(file.read_text("utf-8")).itertext())
    for measurement in {**load_materials(), **load_fingertips()}[name].measured:
        assert f"({measurement.paper})" in text


def test_the_drawn_patch_is_the_one_rendered() -> None:
    for name in load_fingertips():
        scene = {"fingertip": name, "object": [{"name": "table", "shape": "plane", "material": "steel"}]}
        record = Engine(scene).run(np.array([[0.0, 0.0, 0.009, 1.0, 0.0, 0.0, 0.0]]))[0]
        load = np.array([record["contact.normal_force"]])
        drawn = feel_figure.compute_patch_radius(make_library_table("fingertip", name), load)
        assert load[0] == pytest.approx(2.5)  # 1 mm into 2500 N/m
        assert record["contact.patch_radius"] == pytest.approx(drawn[0], rel=1e-12)  # a few roundings


def test_the_drawn_band_of_moduli_follows_hertz() -> None:
    """The formulas for depth and radius of the patch satisfy a^2 = r d of an elastic sphere."""
    load = np.array([0.5, 1.0, 4.0])
    for young in (70e3, 200e3):
        radius = feel_figure.compute_hertz_radius(load, young / 3.0, 0.01)
        assert radius**2 == pytest.approx(0.01 * feel_figure.compute_hertz_depth(load, young, 0.01), rel=1e-12)


def test_check_prints_the_origin_of_values(tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    rows = [line.split(maxsplit=1)[1] for line in read_stdout("check", str(file)).splitlines() if "  library " in line]
    assert rows == [
        "human-index; of the scene itself: radius_m 0.012",
        "rubber; of the scene itself: stiffness_n_per_m 900.0, friction.kinetic 0.5",
        "wood, all of it",
    ]
