"""The material library: what is in it, and how a scene names and changes it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe
from softfinger.config.materials import FILE, library
from softfinger.config.schema import Material, Scene

pytestmark = pytest.mark.plain

NAMES = sorted(library())


def scene_of(material: Any) -> Scene:
    """A plane of a material."""
    thing = {"name": "table", "shape": "plane", "material": material}
    return build(Scene, {"fingertip": {"radius_m": 0.01}, "object": [thing]}, "f.toml")


def material_of(material: Any) -> Material:
    """What a scene's `material` key means."""
    return scene_of(material).object[0].material


def refusal(material: Any) -> str:
    """What a scene with this material is refused with."""
    with pytest.raises(ConfigError) as refused:
        scene_of(material)
    return str(refused.value)


@pytest.mark.parametrize("name", NAMES)
def test_every_material_is_one_a_scene_may_have(name: str) -> None:
    """By its name alone it has numbers within their ranges, friction and torsion."""
    material = material_of(name)
    assert material.name == name
    # Small desktop devices hold 3000 N/m and lose 1 to 2 N s/m by themselves.
    assert 100.0 <= material.stiffness_n_per_m < 3000.0
    assert 0.0 < material.damping_ns_per_m <= 1.0
    assert isinstance(material.friction, schema.Friction)
    assert 0.0 < material.friction.kinetic <= material.friction.static <= 1.0
    assert material.torsion is not None


@pytest.mark.parametrize("name", NAMES)
def test_torsion_follows_its_formula(name: str) -> None:
    """16/3 G a^3 with the moduli of pad and material in series, and 2/3 mu a, for a = 6 mm and a pad of 45 kPa."""
    soft = {"rubber": 600e3, "silicone": 200e3, "skin": 45e3, "sponge": 10e3}
    modulus = 1.0 / (1.0 / 45e3 + (1.0 / soft[name] if name in soft else 0.0))
    material = material_of(name)
    assert material.shear_modulus_pa == soft.get(name)
    assert material.torsion is not None
    assert material.friction is not None
    # The file has two digits of the stiffness and three of the length.
    assert material.torsion.stiffness_nm_per_rad == pytest.approx(16.0 / 3.0 * modulus * 0.006**3, rel=0.01)
    assert material.torsion.friction_length_m == pytest.approx(2.0 / 3.0 * material.friction.static * 0.006, rel=0.002)


def test_the_hand_finds_the_order_it_knows() -> None:
    """Softer things are softer, and slipperier ones more slippery."""
    stiffness = [material_of(n).stiffness_n_per_m for n in ["sponge", "skin", "silicone", "rubber", "wood", "glass"]]
    assert stiffness == sorted(set(stiffness))
    slippery = [library()[n]["friction"]["kinetic"] for n in ["oiled-steel", "steel", "aluminium", "rubber"]]
    assert slippery == sorted(set(slippery))


def test_every_friction_says_where_it_is_from() -> None:
    """The line above each pair of coefficients names a source by its number, and every number is in the list."""
    lines = FILE.read_text().splitlines()
    sources = [above for above, line in pairwise(lines) if line.startswith("friction")]
    assert len(sources) == len(NAMES) >= 12
    for line in sources:
        cited = [part.split("]")[0] for part in line.split("[")[1:]]
        assert cited, line
        assert all(f"#   [{number}] " in FILE.read_text() for number in cited), line


def test_single_keys_can_be_changed() -> None:
    """Keys beside the name take the library's place, down to one coefficient of friction; the rest stays."""
    rubber = material_of("rubber")
    assert rubber.friction is not None
    changed = material_of({"name": "rubber", "stiffness_n_per_m": 900, "friction": {"kinetic": 0.2}})
    assert changed.stiffness_n_per_m == 900.0
    assert changed.friction == schema.Friction(static=rubber.friction.static, kinetic=0.2)
    assert (changed.damping_ns_per_m, changed.torsion) == (rubber.damping_ns_per_m, rubber.torsion)
    assert material_of("rubber") == rubber


def test_a_changed_key_is_checked_like_any_other() -> None:
    """A kinetic coefficient above the library's static one is a fault, and so is a value out of range."""
    assert "at most static = 0.5" in refusal({"name": "wood", "friction": {"kinetic": 0.9}})
    said = refusal({"name": "wood", "stiffness_n_per_m": 2 * limits.STIFFNESS_N_PER_M.high})
    assert "object[0].material.stiffness_n_per_m = 2000000.0" in said


def test_numbers_alone_need_no_name() -> None:
    """A material without a name has what the file says, and lacks what it does not say."""
    material = material_of({"stiffness_n_per_m": 500})
    assert (material.name, material.friction, material.torsion) == (None, None, None)


@pytest.mark.parametrize(
    ("material", "said"),
    [
        ("ruber", "f.toml: object[0].material = 'ruber': not in the library (did you mean 'rubber'?)"),
        ({"name": "Teflon "}, "object[0].material.name = 'Teflon ': not in the library (did you mean 'teflon'?)"),
        ("unobtainium", "; it has steel, "),
        ("", "object[0].material = '': not in the library"),
        ({"name": 3}, "object[0].material.name = 3"),
        (3, "object[0].material = 3: must be a table"),
        ({"friction": {"static": 1, "kinetic": 1}}, "object[0].material.stiffness_n_per_m is missing"),
    ],
)
def test_a_material_that_is_none_is_refused(material: Any, said: str) -> None:
    """A name that the library lacks is answered with the nearest one, and with all there are."""
    assert said in refusal(material)


def test_a_wrong_name_does_not_hide_other_faults() -> None:
    """The faults of the rest of the file are reported together with the unknown material."""
    thing = {"name": "table", "shape": "plane", "material": "ruber"}
    with pytest.raises(ConfigError) as refused:
        build(Scene, {"fingertip": {"radius_m": -1}, "object": [thing]}, "f.toml")
    assert "2 faults" in str(refused.value)
    assert "fingertip.radius_m" in str(refused.value)


@pytest.mark.parametrize("name", NAMES)
def test_a_named_material_survives_a_round_trip(name: str) -> None:
    """Describing a scene with a named material and building it again gives an equal one."""
    scene = scene_of({"name": name, "stiffness_n_per_m": 700})
    assert build(Scene, describe(scene), "again") == scene
