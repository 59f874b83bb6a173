"""Kernel parameters of the laws in a scene file: only those of its features, and one type for all objects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from conftest import SceneFactory, merged, paper_mapping
from references.laws import SPEED

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.kernels import model
from softfinger.proxy.laws import compile_friction_laws, compile_normal_laws, compile_torsion_laws

pytestmark = pytest.mark.plain

LINEAR, HERTZ = model.LinearNormal(1000.0, 0.0), model.PowerNormal(1000.0 * 0.001**-0.5, 1.5, 0.0)
TORSION, POWER, PATCH = model.Torsion(0.05, 0.004), model.PowerTorsion(0.05, 0.004, 0.2), model.PatchTorsion(0.6)
PROXY = {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.003}
COUPLED = {"model": "limit_surface"}
FOLLOWS = {"stiffness_nm_per_rad": None, "friction_length_m": None}
CROSSED = {"exponent": 1.5, "damping_s_per_m": 0.5}
SOFT = {"fingertip": {"patch": {"shear_modulus_pa": 45e3}}}
LAWS: list[tuple[Callable[[Scene], Any], dict[str, Any], Any]] = [
    (compile_normal_laws, {"normal": None}, LINEAR),
    (compile_normal_laws, {"normal": {}}, LINEAR),
    (compile_normal_laws, {"normal": {"exponent": 1.5}}, HERTZ),
    (compile_normal_laws, {"normal": {"damping_s_per_m": 0.5}}, model.HuntCrossley(LINEAR, 0.5)),
    (compile_normal_laws, {"normal": CROSSED}, model.HuntCrossley(HERTZ, 0.5)),
    (compile_friction_laws, {"friction": None}, None),
    (compile_friction_laws, {}, model.Friction(0.6, 0.5)),
    (
        compile_friction_laws,
        {"friction": {"stribeck_speed_m_per_s": 0.1}},
        model.SpeedFriction(0.6, 0.5, model.Stribeck(0.1), 0.0),
    ),
    (compile_friction_laws, {"friction": {"viscous_s_per_m": 2.0}}, model.SpeedFriction(0.6, 0.5, None, 2.0)),
    (
        compile_friction_laws,
        {"friction": {"direction_x": [0.0, 2.0, 0.0]}},
        model.AnisotropicFriction(model.Friction(0.6, 0.5), (0.0, 1.0, 0.0), 1.0, 1.0, 1.0, 1.0),
    ),
    (compile_torsion_laws, {"torsion": None}, None),
    (compile_torsion_laws, {"torsion": {}}, TORSION),
    (compile_torsion_laws, {"torsion": {"exponent": 0.2}}, POWER),
    (compile_torsion_laws, {"torsion": COUPLED}, model.LimitSurface(TORSION)),
    (compile_torsion_laws, {"torsion": COUPLED | {"exponent": 0.2}}, model.LimitSurface(POWER)),
    (compile_torsion_laws, {"torsion": PROXY}, model.SoftFingerProxy(TORSION, 0.75)),
    (compile_torsion_laws, {"torsion": PROXY | {"exponent": 0.2}}, model.SoftFingerProxy(POWER, 0.75)),
]
OF_PATCHES: list[tuple[dict[str, Any], Any]] = [
    ({}, PATCH),
    (FOLLOWS, PATCH),
    (COUPLED, model.LimitSurface(PATCH)),
    (PROXY, model.SoftFingerProxy(PATCH, 0.75)),
    ({**FOLLOWS, "model": "soft_finger_proxy"}, model.SoftFingerProxy(PATCH, 0.5 / 0.6)),
]


@pytest.mark.parametrize(("laws_of", "material", "law"), LAWS)
def test_only_the_features_of_a_scene_are_compiled(
    plane_scene: SceneFactory, laws_of: Callable[[Scene], Any], material: dict[str, Any], law: Any
) -> None:
    tables: dict[str, Any] = {"rolling": None} if material.get("friction", {}) is None else {}
    assert laws_of(plane_scene(material=material, **tables)) == [law]


@pytest.mark.parametrize(("torsion", "law"), OF_PATCHES)
def test_a_patch_replaces_the_torsion_parameters_of_the_material(
    plane_scene: SceneFactory, torsion: dict[str, Any], law: Any
) -> None:
    assert compile_torsion_laws(plane_scene(material={"torsion": torsion}, **SOFT)) == [law]


def objects_of(*materials: dict[str, Any]) -> Scene:
    """Return a scene of the paper's plane, and of planes with these changes of its material."""
    mapping = paper_mapping()
    (table,) = mapping["object"]
    others = [merged(table, {"name": f"object {n}", "material": changes}) for n, changes in enumerate(materials)]
    return build(Scene, mapping | {"object": [table, *others]}, "test scene")


def directed(static: float, kinetic: float, speed: float, viscous: float) -> model.AnisotropicFriction:
    law = model.SpeedFriction(static, kinetic, model.Stribeck(speed), viscous)
    return model.AnisotropicFriction(law, (1.0, 0.0, 0.0), 1.0, 1.0, 1.0, 1.0)


def test_objects_of_a_scene_share_one_law() -> None:
    assert compile_normal_laws(objects_of({"normal": CROSSED})) == [
        model.HuntCrossley(model.PowerNormal(1000.0, 1.0, 0.0), 0.0),
        model.HuntCrossley(HERTZ, 0.5),
    ]
    rich = {"static": 0.4, "kinetic": 0.3, "direction_x": [1.0, 0.0, 0.0], **SPEED}
    laws = [directed(0.6, 0.5, 0.0, 0.0), directed(0.4, 0.3, 0.05, 0.5), directed(0.0, 0.0, 0.0, 0.0)]
    assert compile_friction_laws(objects_of({"friction": rich}, {"friction": None})) == laws
    assert compile_torsion_laws(objects_of({"torsion": PROXY}, {"torsion": None})) == [
        model.SoftFingerProxy(TORSION, 1.0),
        model.SoftFingerProxy(TORSION, 0.75),
        model.SoftFingerProxy(model.Torsion(1.0, 0.0), 1.0),
    ]
    with pytest.raises(ConfigError, match="use limit_surface for all objects with torsion, or for none"):
        objects_of({"torsion": COUPLED})
