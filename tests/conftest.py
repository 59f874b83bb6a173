"""Scenes for the tests, built from the same mappings a scene file holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from softfinger.config.load import build
from softfinger.config.schema import Scene

SceneFactory = Callable[..., Scene]


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` with `changes` put in, table by table; None removes a key."""
    out = dict(base)
    for key, value in changes.items():
        if value is None:
            out.pop(key, None)
        elif isinstance(value, dict):
            out[key] = merged(out.get(key, {}), value)
        else:
            out[key] = value
    return out


def paper_mapping(
    *, table: dict[str, Any] | None = None, material: dict[str, Any] | None = None, **tables: Any
) -> dict[str, Any]:
    """The paper's plane with round numbers and no damping, changed table by table.

    `table` changes keys of the object, `material` those of its material, any other name a table of
    the scene; None removes one. No velocity filter, so that a tick depends on two poses alone.
    """
    base_material = {
        "stiffness_n_per_m": 1000.0,
        "damping_ns_per_m": 0.0,
        "friction": {"static": 0.6, "kinetic": 0.5},
        "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
    }
    base = {
        "fingertip": {"radius_m": 0.01},
        "rolling": {"method": "euler_zxz"},
        "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 0.0},
        "probe": {"velocity_time_constant_s": 0.0},
    }
    thing = merged({"name": "table", "shape": "plane"}, table or {})
    thing["material"] = merged(base_material, material or {})
    return {**merged(base, tables), "object": [thing]}


@pytest.fixture
def plane_scene() -> SceneFactory:
    """Makes scenes of one plane: see `paper_mapping` for what can be changed."""

    def make(**changes: Any) -> Scene:
        return build(Scene, paper_mapping(**changes), "test scene")

    return make
