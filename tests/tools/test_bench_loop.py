"""`bench loop`: the devices that its servo reads."""

from __future__ import annotations

import pytest

from softfinger.config.load import load_rig, load_scene
from softfinger.tools.bench.loop import devices_of

pytestmark = pytest.mark.plain


def test_each_finger_has_the_device_of_its_own_hand() -> None:
    scene = load_scene("lift-a-box")
    with devices_of(load_rig("simulated-lift-a-box"), scene) as (thumb, index):
        assert thumb is not index and thumb.info.name == index.info.name == "simulated omega.6"
    with devices_of(load_rig("replay"), scene) as (thumb, index):
        assert thumb is index
