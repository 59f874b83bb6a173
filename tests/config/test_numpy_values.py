"""Values of a scene may be NumPy's arrays and numbers, as for the clients of a daemon."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softfinger import Engine
from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene

pytestmark = pytest.mark.plain

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
