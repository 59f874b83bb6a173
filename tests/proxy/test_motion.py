"""Moving objects: poses in closed form, and the force on a hand at rest."""

import math
from typing import Any

import numpy as np
import pytest
from conftest import paper_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from references.hand import Array
from references.rotation import matrix

from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.query.motion import compute_pose
from softfinger.proxy.scene import build_scene

pytestmark = pytest.mark.plain

STILL = model.Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
TILTED = model.Pose((0.3, -0.1, 0.2), (0.5, 0.5, -0.5, 0.5))
DRIVEN = model.NO_MOTION._replace(kind=model.DRIVEN)


def sinusoid(translation: Any, axis: Any, angle: float, frequency: float, phase: float) -> model.Motion:
    keys = {"translation": translation, "axis": axis, "angle": angle, "frequency": frequency, "phase": phase}
    return model.NO_MOTION._replace(kind=model.SINUSOID, **keys)


def turntable(axis: Any, rate: float, pivot: Any) -> model.Motion:
    return model.NO_MOTION._replace(kind=model.TURNTABLE, axis=axis, rate=rate, pivot=pivot)


SHAKE = sinusoid((0.01, 0.0, 0.02), (0.0, 0.6, 0.8), 0.4, 2.5, 0.7)
TABLE = turntable((0.0, 0.6, 0.8), 3.0, (0.05, 0.0, -0.02))
MOTIONS = [SHAKE, TABLE]

times = st.floats(0.0, 1000.0)
both = pytest.mark.parametrize("motion", MOTIONS, ids=["sinusoid", "turntable"])


def placed(pose: model.Pose, point: Any) -> Array:
    return np.asarray(matrix(np.array(pose.orientation)) @ np.asarray(point) + pose.position)


def test_without_a_motion_an_object_does_not_move() -> None:
    assert compute_pose(None, TILTED, 123.4) == TILTED
    assert compute_pose(DRIVEN, TILTED, 123.4) == TILTED


def test_sinusoid_swings_by_its_amplitude_in_both_directions() -> None:
    swing = sinusoid((0.01, 0.0, 0.0), (0.0, 0.0, 1.0), 0.5, 2.0, 0.0)
    for time, s in [(0.0, 0.0), (0.125, 1.0), (0.25, 0.0), (0.375, -1.0), (1000.125, 1.0)]:
        pose = compute_pose(swing, STILL, time)
        assert pose.position == pytest.approx((0.01 * s, 0.0, 0.0), abs=1e-14)
        assert pose.orientation == pytest.approx((math.cos(0.25 * s), 0.0, 0.0, math.sin(0.25 * s)), abs=1e-13)


def test_phase_sets_the_start_within_the_cycle() -> None:
    swing = sinusoid((0.0, 0.0, 0.02), (0.0, 0.0, 1.0), 0.0, 5.0, math.pi / 2)
    assert compute_pose(swing, STILL, 0.0).position == pytest.approx((0.0, 0.0, 0.02))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(times)
def test_turntable_does_not_move_its_axis(time: float) -> None:
    pose = compute_pose(TABLE, TILTED, time)
    for along in (-1.0, 0.0, 2.0):
        point = np.array(TABLE.pivot) + along * np.array(TABLE.axis)
        assert placed(pose, point) == pytest.approx(placed(TILTED, point), abs=1e-13)
    corner, pivot = (0.1, 0.2, 0.3), placed(TILTED, TABLE.pivot)
    distance, at_rest = (np.linalg.norm(placed(at, corner) - pivot) for at in (pose, TILTED))
    assert distance == pytest.approx(at_rest, rel=1e-13)


def test_turntable_turns_at_its_rate() -> None:
    table = turntable((0.0, 0.0, 1.0), 2.0, (0.0, 0.0, 0.0))
    for turns in (0.25, 1e6 + 0.25):
        pose = compute_pose(table, STILL, turns * math.pi)
        # The time is a double: at 3e6 s its steps are 5e-10 s, times 2 rad/s.
        assert placed(pose, (1.0, 0.0, 0.0)) == pytest.approx([0.0, 1.0, 0.0], abs=1e-13 if turns < 1.0 else 2e-9)


@both
@settings(max_examples=200, deadline=None, derandomize=True)
@given(time=times)
def test_motion_is_relative_to_the_rest_pose(motion: Any, time: float) -> None:
    here, tilted = compute_pose(motion, STILL, time), compute_pose(motion, TILTED, time)
    for point in [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)]:
        assert placed(tilted, point) == pytest.approx(placed(TILTED, placed(here, point)), abs=1e-14)


@both
@settings(max_examples=200, deadline=None, derandomize=True)
@given(time=st.floats(allow_nan=False, allow_infinity=False))
def test_pose_is_valid_at_any_finite_time(motion: Any, time: float) -> None:
    pose = compute_pose(motion, TILTED, time)
    assert math.hypot(*pose.orientation) == pytest.approx(1.0, abs=1e-14)
    assert np.linalg.norm(np.array(pose.position) - TILTED.position) < 0.2


def test_every_kind_in_a_file_becomes_its_kernel() -> None:
    swing = {"kind": "sinusoid", "translation_m": [0, 0, 0.01], "frequency_hz": 2, "axis": [0, 3, 4]}
    table = {"kind": "turntable", "rate_rad_per_s": -1, "pivot_m": [0.1, 0, 0]}
    expected = [
        (swing, sinusoid((0.0, 0.0, 0.01), (0.0, 0.6, 0.8), 0.0, 2.0, 0.0)),
        (table, turntable((0.0, 0.0, 1.0), -1.0, (0.1, 0.0, 0.0))),
        ({"kind": "driven"}, DRIVEN),
    ]
    for motion, kernel in expected:
        assert build_scene(paper_scene(table={"motion": motion})).objects.body.motion == kernel
    assert build_scene(paper_scene()).objects.body.motion is None
