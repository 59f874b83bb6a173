"""Values that are normalised: NumPy arrays and numbers, as clients of a daemon send, and quaternions of any length."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgpack
import numpy as np
import pytest

from softfinger import Engine
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_scene
from softfinger.config.schema import Tool
from softfinger.drivers.mounting import Mounting
from softfinger.server.wire.envelope import DeclinedRequest, parse

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
