"""Scene `plates` and its recording: a stroke over seven materials gives the library's values."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.config.load import load_scene
from softfinger.config.materials import load_materials
from softfinger.drivers.poses import load_poses
from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain

DEPTH_M = 0.002
"""Depth of the recording: 12 mm down from 20 mm, on plates with their tops at z = 0, with a radius of 10 mm."""

SETTLED = 18
"""Ticks at constant depth after which the velocity filter, 2 ms at ticks of 1 ms, has (2/3)^18 < 1e-3 left."""


def test_plates_are_touched_in_order_with_their_stiffness_and_friction() -> None:
    scene, poses = load_scene("plates"), load_poses("plates")
    records = Engine("plates").run(np.hstack([poses.position, poses.orientation]))
    touched = records["contact.object"]
    first = [
        int(number) for number in touched[touched >= 0][np.flatnonzero(np.diff(touched[touched >= 0], prepend=-1))]
    ]
    assert first == list(range(len(scene.object))) and len(first) == 7
    for number, plate in enumerate(scene.object):
        values = load_materials()[plate.name].values
        pressed = np.flatnonzero((touched == number) & (np.abs(records["contact.penetration"] - DEPTH_M) < 1e-6))[
            SETTLED:
        ]
        normal = records["contact.normal_force"][pressed]
        # Positions are rounded to 0.1 um, 5e-5 of the depth; damping is zero once the velocity filter has settled.
        assert normal == pytest.approx(values["stiffness_n_per_m"] * DEPTH_M, rel=1e-4)
        along = np.abs(records["force"][pressed, 1]) / normal
        slides = records["contact.mode"][pressed] == 2
        friction = values["friction"]
        assert slides.sum() > 30
        # The peak before a slide is exactly the limit.
        assert along.max() == pytest.approx(friction["static"], rel=1e-6)
        assert np.median(along[slides]) == pytest.approx(friction["kinetic"], rel=1e-6)
