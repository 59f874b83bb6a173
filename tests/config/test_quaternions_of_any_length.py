"""Only the direction of a quaternion counts: each place that accepts one normalises it, whatever its length."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgpack
import pytest

from softfinger.config.load import build, load_scene
from softfinger.config.schema import Tool
from softfinger.drivers.mounting import Mounting
from softfinger.server.wire.envelope import DeclinedRequest, parse

pytestmark = pytest.mark.plain

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
    unit = PLACES[place]([length * part for part in DIRECTION])
    # Numbers of 1e-310 have 13 digits.
    assert unit == pytest.approx(DIRECTION, abs=1e-12)


@pytest.mark.parametrize("part", [math.inf, -math.inf, math.nan, 1e308])
def test_a_hand_does_not_turn_to_no_direction(part: float) -> None:
    with pytest.raises(DeclinedRequest, match=r"^bad_params: "):
        led((part, part, part, part))
