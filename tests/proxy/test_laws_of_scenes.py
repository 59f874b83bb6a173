"""Kernel parameters of the laws of several objects in a scene file have one type."""

from __future__ import annotations

from typing import Any

import pytest
from conftest import merged, paper_mapping
from references.laws import SPEED

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.kernels import model
from softfinger.proxy.laws import compile_friction_laws, compile_normal_laws, compile_torsion_laws

pytestmark = pytest.mark.plain

HERTZ, TORSION = model.PowerNormal(1000.0 * 0.001**-0.5, 1.5, 0.0), model.Torsion(0.05, 0.004)
PROXY = {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.003}
COUPLED = {"model": "limit_surface"}
CROSSED = {"exponent": 1.5, "damping_s_per_m": 0.5}


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
