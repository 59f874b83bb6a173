"""Scenes whose laws, motions, effects, tables or names do not fit: changes of shipped scenes, and each message."""

import re
import tomllib
from typing import Any

import pytest
from conftest import paper_mapping
from helpers.refusals import refusal

from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_scene
from softfinger.config.schema import Scene

pytestmark = pytest.mark.plain


TORUS = {"shape": "torus", "major_radius_m": 0.05, "minor_radius_m": 0.02}
ELLIPSOID = {"shape": "ellipsoid", "semi_axes_m": [0.05, 0.03, 0.02]}
CLOSED = {"method": "rotation_vector"}
LETTER = {"state_machine": "paper"}
PROXY = {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.005}
BOUNDARY = {"kind": "boundary", "stiffness_n_per_m": 300, "force_max_n": 5}
VIBRATION = {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 60, "direction": [0, 3, 4]}
TURNTABLE = {"kind": "turntable", "rate_rad_per_s": 1}
HERTZ = {"shear_modulus_pa": 45e3}
PATCH = {"patch": HERTZ}
FOLLOWS = {"stiffness_nm_per_rad": None, "friction_length_m": None}
"""Changes that remove the torsion parameters of the paper's material."""
FINGERS = [{"name": "a", "radius_m": 0.01}, {"name": "b", "radius_m": 0.01, **PATCH}]
NONE = {"friction": None, "torsion": FOLLOWS}

MATERIALS: list[tuple[dict[str, Any], str]] = [
    ({"friction": {"static_scale": [1.0, 0.5]}}, "needs direction_x"),
    ({"friction": {"direction_x": [0.0, 0.0, 0.0]}}, "not a direction"),
    ({"friction": {"direction_x": [1.0, 0.0, 0.0], "static_scale": [1.0, 0.5]}}, "across, above the static 0.3"),
    ({"friction": {"direction_x": [1.0, 0.0, 0.0], "kinetic_scale": [0.0, 0.5]}}, "from 0.001"),
    ({"friction": {"stribeck_speed_m_per_s": 0.0}}, "from 1e-05 to 10 m/s"),
    ({"friction": {"viscous_s_per_m": -1.0}}, "from 0 to 100 s/m"),
    ({"normal": {"exponent": 0.5}}, "from 1 to 3"),
    ({"normal": {"damping_s_per_m": 1.0}, "damping_ns_per_m": 2.0}, "replaces damping_ns_per_m, which is 2"),
    ({"normal": {"depth_m": 0.0}}, "from 1e-05 to 1 m"),
    ({"normal": {"exponnent": 2.0}}, "did you mean 'exponent'"),
    ({"torsion": {"kinetic_friction_length_m": 0.003}}, 'applies to model = "soft_finger_proxy"'),
    ({"torsion": PROXY}, "at most friction_length_m = 0.004"),
    ({"torsion": {"exponent": 0.5}}, "from 0 to 0.333333"),
    ({"torsion": {"model": "soft_finger"}}, "did you mean 'soft_finger_proxy'"),
    ({"torsion": FOLLOWS}, "torsion.stiffness_nm_per_rad: is missing: add it, or add"),
    ({"shear_modulus_pa": 1.0}, "from 100 to 1e"),
]
EFFECTS: list[tuple[Any, str]] = [
    ({"kind": "viscocity", "damping_ns_per_m": 1}, "did you mean 'viscosity'?"),
    (BOUNDARY, "give either size_m"),
    (BOUNDARY | {"size_m": [0.2, 0.2, 0.4], "radius_m": 0.2}, "give either size_m"),
    ({"kind": "viscosity", "damping_ns_per_m": 2, "region": {}}, "effect[0].region.radius_m: give either size_m"),
    (VIBRATION | {"direction": [0, 0, 0]}, "effect[0].direction = [0.0, 0.0, 0.0]: all zero is not a direction"),
    ({"kind": "constant_force", "force_n": [0, 0, -41]}, "from -40 to 40 N"),
    (VIBRATION | {"frequency_hz": 600}, "effect[0].frequency_hz = 600: must be a number from 0 to 500 Hz"),
    ({"kind": "magnet", "force_n": 2, "range_m": 0.02}, "must be one of"),  # an object's effect in the workspace
]
MOTIONS: list[tuple[Any, str]] = [
    (TURNTABLE | {"kind": "turntabel"}, "object[0].motion.kind = 'turntabel': must be one of"),
    ({"kind": "turntable"}, "object[0].motion.rate_rad_per_s is missing"),
    (TURNTABLE | {"rate_rad_per_s": 101}, "from -100 to 100 rad/s"),
    (TURNTABLE | {"axis": [0, 0, 0]}, "object[0].motion.axis = [0.0, 0.0, 0.0]"),
    ({"kind": "sinusoid", "frequency_hz": 200}, "from 0 to 100 Hz"),
    ({"frequency_hz": 2}, "object[0].motion.kind is missing"),
    ([], "object[0].motion = []: must be a table"),
]
TEXTURE = {"file": "heights.npy", "size_m": [0.02, 0.02], "height_m": 2e-4}
ROUND = {"shape": "cylinder", "radius_m": 0.05}
TEXTURES: list[tuple[dict[str, Any], str]] = [
    ({"texture": TEXTURE | {"height_m": None}}, "object[0].texture.height_m: is missing, as is friction_scale"),
    (
        {"texture": TEXTURE | {"height_m": 1.0}},
        "texture.height_m = 1.0: must be a number from 1e-07 to 0.01 m",
    ),
    ({"texture": TEXTURE | {"border": "mirror"}}, "object[0].texture.border = 'mirror': must be"),
    ({"texture": TEXTURE, "shape": "sphere", "radius_m": 0.05}, "object[0].texture is not a key here"),
    ({"texture": TEXTURE} | ROUND, "fits 15.708 times round the cylinder; must be an integer"),
    ({"texture": TEXTURE} | ROUND, "width to 0.019635 m"),
]
SCENES: list[tuple[dict[str, Any], str]] = [
    *(({"material": material}, message) for material, message in MATERIALS),
    *(({"effect": [effect]}, message) for effect, message in EFFECTS),
    *(({"table": {"motion": motion}}, message) for motion, message in MOTIONS),
    *(({"table": table}, message) for table, message in TEXTURES),
    ({"rolling": None, "table": {"texture": TEXTURE | {"friction_scale": [0.5, 1.5]}}, "material": NONE},
     "scales the friction of the material, which has none"),
    ({"table": TORUS, "rolling": CLOSED}, "closed form for the torus object[0]: use montana_rk4"),
    ({"table": ELLIPSOID, "rolling": CLOSED}, "closed form for the ellipsoid object[0]: use montana_rk4"),
    ({"rolling": CLOSED | {"tolerance": 1e-6}}, "tolerance = 1e-06: applies to montana_rk45"),
    ({"rolling": {"method": "montana_rk45", "tolerance": 1e-15}}, "must be a number from 1e-13 to 0.001"),
    ({"rolling": LETTER, "material": {"friction": {"viscous_s_per_m": 0.1}}}, "has Coulomb friction only"),
    ({"rolling": LETTER, "material": {"friction": {"direction_x": [1.0, 0.0, 0.0]}}}, "has Coulomb friction only"),
    ({"rolling": LETTER, "material": {"torsion": {"model": "limit_surface"}}}, "has independent limits only"),
    ({"rolling": None, "material": {"torsion": {"model": "limit_surface"}, "friction": None}}, "shares a limit"),
    ({"fingertip": {"patch": {}}}, "fingertip.patch.shear_modulus_pa is missing"),
    ({"fingertip": {"patch": HERTZ | {"exponent": 0.2}}}, "applies to a patch with radius_m, not to that of Hertz"),
    ({"fingertip": {"patch": HERTZ | {"pressure_exponent": 4.0}}}, "applies to a patch with radius_m"),
    ({"fingertip": {"patch": HERTZ | {"rolling_loss": 1.5}}}, "from 0 to 1 "),
    ({"fingertip": None, "finger": FINGERS}, "finger[0].patch: is missing, but another finger has a patch"),
    ({"fingertip": None, "finger": FINGERS[:1], "material": {"torsion": FOLLOWS}}, "add it, or add [finger.patch]"),
    ({"fingertip": PATCH, "rolling": None, "material": NONE}, "derived from patch and friction, but the material has"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), SCENES)
def test_a_scene_that_does_not_fit_is_refused(changes: dict[str, Any], message: str) -> None:
    assert message in refusal(build, Scene, paper_mapping(**changes), "test scene")


@pytest.mark.parametrize(
    ("scene", "place", "name"),
    [
        ("bend-a-strip", ("object", 0, "elastic"), "fixed"),
        ("bend-a-strip", ("object", 0), "material"),
        ("paper-plane", (), "object"),
    ],
)
def test_the_header_of_a_missing_table_is_toml(scene: str, place: tuple[str | int, ...], name: str) -> None:
    mapping = table = describe(load_scene(scene))
    for key in place:
        table = table[key]
    del table[name]
    with pytest.raises(ConfigError) as refused:
        load_scene(mapping)
    (header,) = re.findall(r"\[+[\w.\[\]]+\]$", str(refused.value))
    written = tomllib.loads(header)
    for key in (*(part for part in place if isinstance(part, str)), name):
        written = written[key]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world.geom.0.name": "bal"}, r"world\.geom\[0\] fits no geom of .*: name = 'bal'; it has bowl, ball"),
        ({"world.geom.0.group": 7}, r"world\.geom\[0\] fits no geom of .*: name = 'ball', group = 7"),
        ({"world.geom.0.default": "rubber"}, r"world\.geom\[0\] fits no geom of .*: name = 'ball', default = "),
        ({"world.mass_kg": {"bal": 0.1}}, "'bal' is not a body with a mass; it has ball"),
        ({"world.keyframe": "home"}, "has no such <key>; it has: none"),
        ({"object.bowl.motion": {"kind": "body", "body": "bal"}}, r"motion\.body = 'bal' is not a body .*; it has"),
    ],
)  # fmt: skip
def test_a_misspelt_name_is_refused_on_load(changes: dict[str, Any], message: str) -> None:
    load_scene("ball-in-a-bowl")
    with pytest.raises(ConfigError, match=message):
        load_scene("ball-in-a-bowl", changes)
