"""Library of materials and fingertips: its entries, and how a scene refers to and overrides them."""

import math
from typing import Any

import pytest
from helpers.refusals import refusal

from softfinger.config import limits, schema
from softfinger.config.load import apply_overrides, build, describe, load_scene
from softfinger.config.materials import LibraryEntry, load_fingertips, load_materials, load_papers
from softfinger.config.schema import Fingertip, Material, Scene

pytestmark = pytest.mark.plain

NAMES = sorted(load_materials())
TIPS = sorted(load_fingertips())
ENTRIES = {**load_materials(), **load_fingertips()}


def scene_of(material: Any) -> Scene:
    table = {"name": "table", "shape": "plane", "material": material}
    return build(Scene, {"fingertip": {"radius_m": 0.01}, "object": [table]}, "f.toml")


def material_of(material: Any) -> Material:
    """Return the material that a scene builds from its `material` key."""
    return scene_of(material).object[0].material


@pytest.mark.parametrize("name", NAMES)
def test_every_material_is_one_a_scene_may_have(name: str) -> None:
    scene = scene_of({"name": name, "stiffness_n_per_m": 700})
    assert build(Scene, describe(scene), "again") == scene
    material = material_of(name)
    assert material.name == name
    # Small desktop devices render up to 3000 N/m and have 1 to 2 N s/m of physical damping.
    assert 100.0 <= material.stiffness_n_per_m < 3000.0 and 0.0 < material.damping_ns_per_m <= 1.0
    assert 0.0 < material.friction.kinetic <= material.friction.static <= 1.0 and material.torsion is not None


@pytest.mark.parametrize("name", NAMES)
def test_torsion_follows_its_formula(name: str) -> None:
    soft = {"rubber": 600e3, "silicone": 200e3, "skin": 45e3, "foam": 30e3, "sponge": 10e3}
    modulus = 1.0 / (1.0 / 45e3 + (1.0 / soft[name] if name in soft else 0.0))
    material = material_of(name)
    assert material.shear_modulus_pa == soft.get(name)
    # The file rounds the stiffness to two digits and the length to three.
    assert material.torsion.stiffness_nm_per_rad == pytest.approx(16.0 / 3.0 * modulus * 0.006**3, rel=0.01)
    assert material.torsion.friction_length_m == pytest.approx(2.0 / 3.0 * material.friction.static * 0.006, rel=0.002)


def test_names_of_materials_and_fingertips_are_distinct() -> None:
    assert not set(NAMES) & set(TIPS) and len(NAMES) >= 18 and len(TIPS) >= 5
    papers_by_entry = [[*entry.papers, *(row.paper for row in entry.measured)] for entry in ENTRIES.values()]
    in_ranges = {name for name in load_papers() for entry in ENTRIES.values() if name in entry.holds}
    assert {name for names in papers_by_entry for name in names} | in_ranges == set(load_papers())


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES)
def test_every_entry_has_sources_and_a_range(entry: LibraryEntry) -> None:
    assert entry.papers and entry.holds and entry.about.endswith(".")
    assert bool(entry.friction_of) == ("friction" in entry.values)
    for row in entry.measured:
        quantities = [row.friction, row.youngs_modulus_pa, row.patch_exponent]
        assert sum(value is not None for value in quantities) == 1
        assert row.of and (row.low is None or row.friction is None or row.low <= row.friction)
        for span in (row.youngs_modulus_pa, row.patch_exponent, row.load_n):
            assert span is None or span[0] <= span[1]


def test_sources_have_valid_dois() -> None:
    for paper in load_papers().values():
        assert paper.read and paper.text
        registrant, slash, rest = paper.doi.partition("/")
        assert not paper.doi or (registrant[:3] == "10." and registrant[3:].isdecimal() and slash and rest)


def test_finger_pad_depth_follows_hertz() -> None:
    """F = 4/3 E* sqrt(r) d^1.5 with E* = 4 G of `human-index`; its modulus is within the measured range."""
    material, tip = material_of("finger-pad"), tip_of("human-index")
    reduced = 4.0 * tip.patch.shear_modulus_pa
    for force in (0.1, 1.0, 5.0):
        deep = (3.0 * force / (4.0 * reduced * math.sqrt(tip.radius_m))) ** (2.0 / 3.0)
        assert material.depth_under(force) == pytest.approx(deep, rel=1e-3)  # three digits of the stiffness
    soft, stiff = load_materials()["finger-pad"].measured[0].youngs_modulus_pa
    assert soft < 3.0 * tip.patch.shear_modulus_pa < stiff


def tip_of(fingertip: Any) -> Fingertip:
    """Return the fingertip that a scene builds from its `fingertip` key."""
    table = {"name": "table", "shape": "plane", "material": "wood"}
    return build(Scene, {"fingertip": fingertip, "object": [table]}, "f.toml").fingertip


@pytest.mark.parametrize("name", TIPS)
def test_every_fingertip_is_one_a_scene_may_have(name: str) -> None:
    tip = tip_of(name)
    assert tip == tip_of({"pad": name})
    assert tip.patch is not None and tip.radius_m is not None and 0.005 <= tip.radius_m <= 0.015


def test_the_human_pads_have_one_patch_at_1_n() -> None:
    """The patch radius of laws other than Hertz's is that of Hertz at 1 N, (3 r / 16 G)^(1/3)."""
    hertz = (3.0 * 0.01 / (16.0 * 45e3)) ** (1.0 / 3.0)
    for name in ("human-index-plateau", "human-index-paraboloid"):
        assert tip_of(name).patch.radius_m == pytest.approx(hertz, rel=1e-4)  # given with four digits


def test_the_paraboloid_has_a_paraboloid_s_mean_distance() -> None:
    k = tip_of("human-index-paraboloid").patch.pressure_exponent

    def beta(a: float, b: float) -> float:
        return math.gamma(a) * math.gamma(b) / math.gamma(a + b)

    assert beta(3 / k, 1 + 1 / k) / beta(2 / k, 1 + 1 / k) == pytest.approx(8.0 / 15.0, rel=1e-4)  # k has four digits


def test_fingertip_keys_override_the_library() -> None:
    patch = tip_of("human-index").patch
    assert tip_of({"pad": "human-index", "radius_m": 0.008}).radius_m == 0.008
    oval = tip_of({"pad": "human-index", "radii_m": [0.008, 0.007, 0.012]})
    assert (oval.radius_m, oval.radii_m, oval.patch) == (None, (0.008, 0.007, 0.012), patch)
    lossy = tip_of({"pad": "human-index", "patch": {"rolling_loss": 0.3}}).patch
    assert (lossy.rolling_loss, lossy.shear_modulus_pa) == (0.3, patch.shear_modulus_pa)


def test_each_finger_may_refer_to_a_pad() -> None:
    fingers = [{"name": "thumb", "pad": "human-index-plateau"}, {"name": "index", "pad": "rubber-tip"}]
    table = {"name": "table", "shape": "plane", "material": "wood"}
    scene = build(Scene, {"finger": fingers, "object": [table]}, "f.toml")
    assert [finger.patch for finger in scene.finger] == [tip_of(fields["pad"]).patch for fields in fingers]
    assert build(Scene, describe(scene), "again") == scene


def test_an_unknown_fingertip_is_refused_with_the_nearest() -> None:
    message = refusal(tip_of, "human-indx")
    assert "fingertip = 'human-indx': not in the library (did you mean 'human-index'" in message
    assert "fingertip.pad = 'x': not in the library" in refusal(tip_of, {"pad": "x"})


def test_a_described_scene_does_not_read_the_library() -> None:
    mapping = describe(scene_of({"name": "rubber", "torsion": None}))
    assert build(Scene, mapping, "again").object[0].material.torsion is None
    mapping["object"][0]["material"] |= {"name": "of another version", "stiffness_n_per_m": 123.0}
    material = build(Scene, mapping, "again").object[0].material
    assert (material.name, material.stiffness_n_per_m) == ("of another version", 123.0)
    assert material.shear_modulus_pa == 600e3


def test_an_override_reaches_into_a_named_table() -> None:
    table = {"name": "table", "shape": "plane", "material": "rubber"}
    file = {"fingertip": "human-index", "object": [table]}
    own = {"object.table.material.friction.kinetic": 0.2, "fingertip.radius_m": 0.008}
    for scene in (load_scene(file, own), apply_overrides(load_scene(file), own, "override")):
        assert scene.object[0].material == material_of({"name": "rubber", "friction": {"kinetic": 0.2}})
        assert scene.fingertip == tip_of({"pad": "human-index", "radius_m": 0.008})
    for key, value in (("object.table.material", "wood"), ("object.table.material.name", "wood")):
        overridden = apply_overrides(load_scene(file, own), {key: value, "fingertip.pad": "rubber-tip"}, "override")
        assert overridden.object[0].material == material_of("wood")
        assert overridden.fingertip == tip_of("rubber-tip")


def test_single_keys_can_be_changed() -> None:
    rubber = material_of("rubber")
    changed = material_of({"name": "rubber", "stiffness_n_per_m": 900, "friction": {"kinetic": 0.2}})
    assert changed.stiffness_n_per_m == 900.0
    assert changed.friction == schema.Friction(static=rubber.friction.static, kinetic=0.2)
    assert (changed.damping_ns_per_m, changed.torsion) == (rubber.damping_ns_per_m, rubber.torsion)
    assert material_of("rubber") == rubber


def test_a_changed_key_is_checked_like_any_other() -> None:
    assert "at most static = 0.5" in refusal(scene_of, {"name": "wood", "friction": {"kinetic": 0.9}})
    message = refusal(scene_of, {"name": "wood", "stiffness_n_per_m": 2 * limits.STIFFNESS_N_PER_M.high})
    assert "object[0].material.stiffness_n_per_m = 2000000.0" in message


def test_a_material_without_a_name_has_only_the_given_values() -> None:
    material = material_of({"stiffness_n_per_m": 500})
    assert (material.name, material.friction, material.torsion) == (None, None, None)


@pytest.mark.parametrize(
    ("material", "reason"),
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
def test_an_unknown_material_is_refused(material: Any, reason: str) -> None:
    assert reason in refusal(scene_of, material)


def test_a_wrong_name_does_not_hide_other_faults() -> None:
    table = {"name": "table", "shape": "plane", "material": "ruber"}
    message = refusal(build, Scene, {"fingertip": {"radius_m": -1}, "object": [table]}, "f.toml")
    assert "2 faults" in message and "fingertip.radius_m" in message
