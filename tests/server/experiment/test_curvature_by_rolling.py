"""Hand motion of the shipped experiment `curvature-by-rolling`, simulated on the scenes of both conditions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.sources import EXPERIMENTS
from softfinger.drivers import quaternions
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.numerics.rotations import exp
from softfinger.server.experiment.checks import load
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.hands import interpolate_path
from softfinger.server.experiment.parameters import load_changed_scene
from softfinger.server.experiment.schema import SINGLE_FINGER

pytestmark = pytest.mark.plain

ROLLING, SLIDING = 1, 2
RADIUS_M = 0.01
FRICTION = 0.5
"""Kinetic friction coefficient of both scenes."""


def simulate_condition(condition: str, radius_m: float) -> tuple[Any, NDArray[np.float64]]:
    experiment, folder = load("curvature-by-rolling", {})
    path, turns = experiment.motion[SINGLE_FINGER], experiment.turn[SINGLE_FINGER]
    times = np.arange(0.0, 1.5, 0.005)
    poses = np.array([[*interpolate_path(path, t), *quaternions.exp(interpolate_path(turns, t))] for t in times])
    name = experiment.factor[0].scenes[condition]
    values = {"object.sphere.radius_m": radius_m, "object.sphere.position_m.2": -radius_m}
    scene = load_changed_scene(folder / name if name.endswith(".toml") else name, values, "a test")
    return Engine(scene).run(poses), poses


@pytest.mark.parametrize("radius_m", [0.04, 0.02])  # reference radius and smallest radius of all levels
def test_with_rolling_the_finger_never_slides(radius_m: float) -> None:
    """The finger never slides, and the tangential force is coupling stiffness times the lag of the rolling proxy."""
    records, poses = simulate_condition("rolls", radius_m)
    mode = records["contact.mode"]
    first = int(np.argmax(mode == ROLLING))
    assert (mode[first:] == ROLLING).all() and first < 100
    # The proxy touches at the angle -asin(5 mm / (r + R)) from the top and rolls on by theta r / (r + R), where r theta
    # is the displacement of the probe. The probe moves on a straight line, so its tangential distance from the proxy
    # loads the coupling of 1000 N/m.
    reach = radius_m + RADIUS_M
    proxy = (poses[-1, 0] + 0.005) / reach - np.arcsin(0.005 / reach)
    x, z = poses[-1, 0], poses[-1, 2] + radius_m
    lag = np.hypot(x, z) * np.sin(np.arctan2(x, z) - proxy)
    normal, force = records["contact.normal_force"][-1], records["force"][-1]
    tangential = float(np.sqrt(force @ force - normal**2))
    assert tangential == pytest.approx(1000.0 * lag, rel=0.05)  # the damper of 1 N s/m contributes a few hundredths
    assert tangential < 0.6 * FRICTION * normal


def test_without_rolling_the_same_movement_drags() -> None:
    records, _ = simulate_condition("slides", 0.04)
    slides = records["contact.mode"] == SLIDING
    assert slides[-100:].all()
    force, normal = records["force"][-100:], records["contact.normal_force"][-100:]
    tangential = np.sqrt((force * force).sum(axis=1) - normal**2)
    assert np.median(tangential / normal) == pytest.approx(FRICTION, rel=1e-6)


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), (0.0, 0.5, 0.0), (-1.0, 2.0, 0.3), (1e-9, 0.0, 0.0)])
def test_a_rotation_vector_turns_as_the_kernels_have_it(rotation: tuple[float, float, float]) -> None:
    assert quaternions.exp(rotation).tolist() == pytest.approx(exp(rotation), abs=4e-16)


def test_a_turn_needs_a_motion() -> None:
    with pytest.raises(ConfigError, match=r"turn\.thumb: rotates a hand that \[motion\] does not move"):
        Experiment(EXPERIMENTS / "curvature-by-rolling.toml", {"turn.thumb": [[0.0, 0.0, 0.0, 0.0]]})
