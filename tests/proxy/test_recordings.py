"""Shipped recordings: equal to the tool's output, with the contact events and materials they are shipped for."""

import functools
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from helpers.touching import causes

from softfinger.config.load import load_scene
from softfinger.config.materials import load_materials
from softfinger.drivers.poses import SHIPPED, list_shipped_recordings, load_poses
from softfinger.drivers.resample import close_loop, resample
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import FREE, ROLLING, SLIDING
from softfinger.tools import recordings

pytestmark = pytest.mark.plain

R = 0.01


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine("paper-plane", rate_hz=1000.0)


@pytest.fixture(scope="module")
def letter() -> Engine:
    return Engine(load_scene("paper-plane", {"rolling.state_machine": "paper"}), rate_hz=1000.0)


def run(engine: Engine, name: str) -> np.ndarray:
    engine.reset()
    return engine.run(resample(load_poses(name), 1.0 / engine.dt))


def test_tool_writes_the_shipped_bytes(tmp_path: Path) -> None:
    written = recordings.write(tmp_path)
    assert sorted(path.stem for path in written) == list_shipped_recordings()
    for path in written:
        assert path.read_bytes() == (SHIPPED / path.name).read_bytes() and path.stat().st_size <= 160_000


@pytest.mark.parametrize("name", list(recordings.RECORDINGS))
def test_recording_starts_and_ends_free_in_one_pose(name: str) -> None:
    poses = load_poses(name)
    assert poses.position[0].tolist() == poses.position[-1].tolist() == list(recordings.RECORDINGS[name].start)
    assert poses.orientation[0].tolist() == poses.orientation[-1].tolist() == [1.0, 0.0, 0.0, 0.0]
    samples = resample(poses, 1000.0)
    assert len(close_loop(samples, 1000.0)) == len(samples) - 1


def test_all_modes_occur() -> None:
    records = run(Engine("paper-plane", rate_hz=250.0), "press-roll-spin-drag")
    assert {FREE, ROLLING, SLIDING} == set(records["contact.mode"].astype(int))
    order = causes(records)
    assert order[:2] == ["touch", "drag"] and order[-1] == "release"
    assert "stop" in order and "theta_max" not in order
    # The spins reach the torsional limit: 4 mm of friction length at 1 N.
    assert np.abs(records["torque"][:, 2]).max() >= 0.99 * 0.004


def test_three_taps(engine: Engine) -> None:
    records = run(engine, "tap")
    assert causes(records) == ["touch", "release"] * 3
    assert records["contact.normal_force"].max() == pytest.approx(1.0, abs=1e-9)


class Roll(NamedTuple):
    """Followed roll by 1 rad while the finger is pressed in: mode, tangential force (N), angle since touch (rad), and
    the path of the contact point on the plane less that on the finger (m), each (n,); causes of the whole run."""

    mode: np.ndarray
    force: np.ndarray
    rolled: np.ndarray
    slip: np.ndarray
    causes: list[str]


@functools.cache
def recorded_roll(engine: Engine, aside: float = 0.0) -> Roll:
    """Run the recorded roll after a drag across it by `aside` m."""
    poses = resample(load_poses("roll-follow"), 1000.0)
    pressed = np.flatnonzero(poses[:, 2] < R - 0.9e-3)
    poses[pressed[0] :, 0] += np.interp(np.arange(len(poses) - pressed[0]), [0, 200], [0.0, aside])
    engine.reset()
    whole = engine.run(poses)
    records = whole[pressed]
    ways = [np.linalg.norm(np.diff(records[f"contact.{point}"], axis=0), axis=1) for point in ("point", "finger_point")]
    slip = np.concatenate([[0.0], np.cumsum(ways[0] - ways[1])])
    mode, force, rolled = (records[f"contact.{name}"] for name in ("mode", "tangential_force", "rolled"))
    return Roll(mode, force, rolled, slip, causes(whole))


@pytest.mark.parametrize("aside", [0.0, 0.4e-3])
def test_a_recorded_roll_rolls_and_does_not_slip(engine: Engine, aside: float) -> None:
    """Both failures absent: the contact point travels as far on the plane as on the finger, and under the force of a
    drag of 0.4 mm, too, the roll is rolling to its end."""
    roll = recorded_roll(engine, aside)
    assert (roll.mode == ROLLING).all() and (aside or roll.causes == ["touch", "release"])
    # Positions rounded to 0.1 um, and slerp against cubic between 100 Hz samples: 0.2 um at 1000 N/m.
    assert roll.force[200:].min() > 0.39 if aside else roll.force.max() < 1e-3
    # The quaternions of the recording have eight decimals.
    assert roll.rolled[-1] == pytest.approx(1.0, abs=1e-6)
    # The chord of the finger's arc of up to 1 mrad per tick is shorter by 4e-8 of it.
    assert aside or np.abs(roll.slip).max() < 1e-9


@pytest.mark.parametrize("aside", [0.0, 0.4e-3])
def test_letter_never_detects_rolling_again(letter: Engine, aside: float) -> None:
    """Both failures present: at theta_max, 0.06 rad, the paper's rule slips by 0.5 mm and slides for ever."""
    roll = recorded_roll(letter, aside)
    slides = int(np.argmax(roll.mode == SLIDING))
    assert roll.rolled[slides - 1] <= 0.06 < roll.rolled[slides] < 0.061
    assert (roll.mode[slides:] == SLIDING).all()
    if aside == 0.0:
        # An unwound deflection of mu_d f_N / K in one tick; the tick's roll is at most 10 um.
        assert roll.slip[slides] - roll.slip[slides - 1] == pytest.approx(0.5e-3, abs=1e-5)
        rolling_on = slice(slides, int(np.argmax(roll.rolled > 0.999)))
        assert roll.force[rolling_on] == pytest.approx(0.5, abs=1e-3)
    # The finger is at rest in the last 0.2 s before the release.
    assert np.ptp(roll.rolled[-150:]) < 1e-9 and len(roll.mode) - slides > 1500


def test_every_recording_has_a_description() -> None:
    descriptions = tomllib.loads((SHIPPED / "motions.toml").read_text("utf-8"))
    assert sorted(descriptions) == list_shipped_recordings()
    assert all(set(description) == {"motion", "course"} for description in descriptions.values())


def test_plates_are_touched_in_order_with_their_stiffness_and_friction() -> None:
    scene, poses, depth = load_scene("plates"), load_poses("plates"), 0.002
    records = Engine("plates").run(np.hstack([poses.position, poses.orientation]))
    touched = records["contact.object"]
    on_plates = touched[touched >= 0]
    assert on_plates[np.diff(on_plates, prepend=-1) != 0].tolist() == list(range(7)) == list(range(len(scene.object)))
    for number, plate in enumerate(scene.object):
        values = load_materials()[plate.name].values
        at_depth = (touched == number) & (np.abs(records["contact.penetration"] - depth) < 1e-6)
        # After 18 ticks the velocity filter, 2 ms at ticks of 1 ms, has (2/3)^18 < 1e-3 left.
        pressed = np.flatnonzero(at_depth)[18:]
        normal = records["contact.normal_force"][pressed]
        # Positions are rounded to 0.1 um, 5e-5 of the depth.
        assert normal == pytest.approx(values["stiffness_n_per_m"] * depth, rel=1e-4)
        along = np.abs(records["force"][pressed, 1]) / normal
        slides, friction = records["contact.mode"][pressed] == 2, values["friction"]
        assert slides.sum() > 30
        # The peak before a slide is exactly the limit.
        assert along.max() == pytest.approx(friction["static"], rel=1e-6)
        assert np.median(along[slides]) == pytest.approx(friction["kinetic"], rel=1e-6)
