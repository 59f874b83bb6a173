"""The shipped recordings: written by the tool to the byte, and doing in contact what they are shipped for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softfinger.drivers.poses import SHIPPED, load_poses, shipped_names
from softfinger.drivers.resample import close_loop, resample
from softfinger.proxy.engine import Engine
from softfinger.proxy.state import CAUSE_NAMES, FREE, OFFSET, ROLLING, SLIDING
from softfinger.tools import recordings


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine("paper-plane", rate_hz=1000.0)


def run(engine: Engine, name: str) -> np.ndarray:
    engine.reset()
    return engine.run(resample(load_poses(name), 1000.0))


def causes(records: np.ndarray) -> list[str]:
    cause = records[:, OFFSET["contact.cause"]].astype(int)
    return [CAUSE_NAMES[i] for i in cause[cause != 0]]


def test_tool_writes_the_shipped_bytes(tmp_path: Path) -> None:
    """Running the generator again gives the shipped files, byte for byte, and they are small."""
    written = recordings.write(tmp_path)
    assert sorted(path.stem for path in written) == shipped_names()
    for path in written:
        assert path.read_bytes() == (SHIPPED / path.name).read_bytes()
        assert path.stat().st_size <= 120_000


@pytest.mark.parametrize("name", list(recordings.RECORDINGS))
def test_recording_starts_and_ends_free_in_one_pose(name: str) -> None:
    """Start and end are the same pose above the plane, at rest, so looping adds no return."""
    poses = load_poses(name)
    assert poses.position[0].tolist() == poses.position[-1].tolist() == [0.0, 0.0, 0.02]
    assert poses.orientation[0].tolist() == poses.orientation[-1].tolist() == [1.0, 0.0, 0.0, 0.0]
    samples = resample(poses, 1000.0)
    assert len(close_loop(samples, 1000.0)) == len(samples) - 1


def test_all_modes_occur(engine: Engine) -> None:
    """The main recording is free, rolls and slides; small and followed rolls and spins alone do not slide."""
    records = run(engine, "press-roll-spin-drag")
    assert {FREE, ROLLING, SLIDING} == set(records[:, OFFSET["contact.mode"]].astype(int))
    order = causes(records)
    assert order[:2] == ["touch", "drag"]
    assert order[-1] == "release"
    assert "stop" in order
    assert "theta_max" not in order
    spin = records[:, OFFSET["torque"] + 2] + 0.0
    torsion = 0.004  # N m: 4 mm of friction length at 1 N
    assert np.abs(spin).max() >= 0.99 * torsion  # the spins pass the torsional limit


def test_followed_roll_only_touches_and_releases(engine: Engine) -> None:
    """A roll of 1 rad that the hand follows never slides, and its tangential force stays near zero."""
    records = run(engine, "roll-follow")
    assert causes(records) == ["touch", "release"]
    # positions rounded to 0.1 um, and slerp against cubic between 100 Hz samples: 0.2 um at 1000 N/m
    assert records[:, OFFSET["contact.tangential_force"]].max() < 1e-3
    assert records[:, OFFSET["contact.rolled"]].max() == pytest.approx(1.0, abs=1e-6)


def test_three_taps(engine: Engine) -> None:
    """Each tap touches and releases, straight on."""
    records = run(engine, "tap")
    assert causes(records) == ["touch", "release"] * 3
    assert records[:, OFFSET["contact.normal_force"]].max() == pytest.approx(1.0, abs=1e-9)
