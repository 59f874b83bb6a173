"""Recorded poses: reading, checking, resampling, closing into a loop."""

import logging
import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from softfinger.config.errors import RecordingError
from softfinger.drivers.poses import ENDINGS, RESULT_COLUMNS, Poses, check_poses, list_shipped_recordings, load_poses
from softfinger.drivers.resample import close_loop, resample
from softfinger.proxy.record import AT, RECORD_SIZE, list_columns
from softfinger.server.recording.results import write_blocks

pytestmark = pytest.mark.plain

HEADER = "t,x,y,z,qw,qx,qy,qz\n"
ROWS = "0,0,0,0.02,1,0,0,0\n0.01,0.001,0,0.02,1,0,0,0\n0.02,0.002,0,0.02,1,0,0,0\n"


def some_poses(count: int = 40, seed: int = 7) -> Poses:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.004, 0.02, count))
    quaternion = np.cumsum(rng.normal(0, 0.1, (count, 4)), axis=0) + np.array([2.0, 0, 0, 0])
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return check_poses(t, np.cumsum(rng.normal(0, 0.002, (count, 3)), axis=0), quaternion, str)


def records_of(poses: Poses) -> np.ndarray:
    records = np.zeros((len(poses.t), RECORD_SIZE))
    records[:, AT.timestamp] = 1.7e9 + poses.t
    records[:, AT.tick] = np.arange(len(poses.t))
    records[:, AT.probe_position : AT.probe_position + 3] = poses.position
    records[:, AT.probe_orientation : AT.probe_orientation + 4] = poses.orientation
    return records


def test_csv_in_any_column_order(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("qw, qx,qy,qz,note,t,x,y,z\n1,0,0,0,a,0,1,2,3\n\n1,0,0,0,b,0.5,4,5,6\n", encoding="utf-8-sig")
    poses = load_poses(path)
    assert poses.t.tolist() == [0.0, 0.5] and poses.position.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert poses.orientation.tolist() == [[1, 0, 0, 0]] * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: column.*t, x"),
        ("t,x,y,z,qw,qx,qy\n", "line 1: column.*qz missing"),
        ("t,x,y,z,qw,qx,qy,qz,t\n" + ROWS, "line 1: column.*t missing or duplicate"),
        (HEADER, "0 pose"),
        (HEADER + ROWS + "0.03,0,O,0,1,0,0,0\n", "line 5, column 'y': 'O' is not a number"),
        (HEADER + ROWS + "0.03,0,0,0,1,0,0\n", "line 5: 7 values, but the header has 8 columns"),
        (HEADER + ROWS + "0.03,0,nan,0,1,0,0,0\n", "line 5, column 'y': nan is not a finite"),
        (HEADER + ROWS + "\n0.02,0,0,0,1,0,0,0\n", "line 6, column 't': 0.02 s does not follow 0.02 s"),
        (HEADER + ROWS + "0.03,0,0,0,0.1,0,0,0\n", "line 5, columns 'qw' to 'qz': quaternion of norm 0.1"),
        (HEADER + ROWS + "0.03,1e9,0,0,1,0,0,0\n", "line 5, column 'x': 1e.09 m is outside"),
        (HEADER + "1e308,0,0,0,1,0,0,0\n-1e308,0,0,0,1,0,0,0\n", "line 3, column 't'"),
        (HEADER + ROWS + "\xff\n", "line 5: not a text file"),
    ],
)
def test_csv_fault_is_located(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(RecordingError, match="bad.csv.*" + message):
        load_poses(path)


def test_unknown_names_are_refused_with_the_known(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"did you mean 'roll-follow'.*press-roll-spin-drag"):
        load_poses("rol-follow")
    with pytest.raises(RecordingError, match="not a usable file name"):
        load_poses("a" * 5000)
    (tmp_path / "poses.txt").write_text(HEADER + ROWS)
    with pytest.raises(RecordingError, match=r"\.csv, \.npz, \.mcap"):
        load_poses(tmp_path / "poses.txt")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(RecordingError, match="cannot be read"):
        load_poses(tmp_path / "folder.csv")


def test_shipped_recordings_load() -> None:
    assert {"tap", "press-roll-spin-drag", "lift-thumb"} < set(list_shipped_recordings())
    for name in list_shipped_recordings():
        assert load_poses(name).t.tolist() == load_poses(name + ".csv").t.tolist()


def test_orientation_is_normalised_and_continuous_in_sign() -> None:
    poses = some_poses()
    flipped = poses.orientation * np.random.default_rng(3).choice([-1.6, 1.4], (len(poses.t), 1))
    rechecked = check_poses(poses.t, poses.position, flipped, str)
    sign = np.sign(flipped[0] @ poses.orientation[0])
    np.testing.assert_allclose(rechecked.orientation, sign * poses.orientation, atol=4e-16)  # two roundings
    assert np.all(np.sum(rechecked.orientation[1:] * rechecked.orientation[:-1], axis=1) > 0)


@pytest.mark.parametrize("ending", ENDINGS)
def test_results_are_poses(tmp_path: Path, ending: str) -> None:
    assert set(RESULT_COLUMNS) <= set(list_columns())
    poses = some_poses()
    path = tmp_path / f"results{ending}"
    write_blocks(path, [""], [records_of(poses)[:, None]])
    reloaded = load_poses(path)
    np.testing.assert_allclose(reloaded.t, poses.t - poses.t[0], atol=5e-7)  # resolution of an epoch time in float64
    assert reloaded.position.tobytes() == poses.position.tobytes()
    np.testing.assert_allclose(reloaded.orientation, poses.orientation, atol=4e-16)  # normalised once more


def test_a_truncated_mcap_gives_its_first_part(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    poses = some_poses(2000)
    path = tmp_path / "whole.mcap"
    write_blocks(path, [""], [records_of(poses)[:, None]])
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with caplog.at_level(logging.WARNING, logger="softfinger"):
        part = load_poses(path)
    assert 100 < len(part.t) < 2000 and part.position.tobytes() == poses.position[: len(part.t)].tobytes()
    assert "truncated or damaged" in caplog.text
    path.write_bytes(whole[:40])
    with pytest.raises(RecordingError, match="not a readable MCAP"):
        load_poses(path)


def test_invalid_npz_files_are_rejected(tmp_path: Path) -> None:
    path, marker = tmp_path / "x.npz", tmp_path / "pickle-ran"

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (open, (str(marker), "w"))

    for arrays in (
        {"timestamp": np.arange(3.0)},
        {"timestamp": np.arange(3.0), "probe.position": np.zeros((3, 2)), "probe.orientation": np.ones((3, 4))},
        {"timestamp": np.arange(3.0), "probe.position": np.zeros((3, 3)), "probe.orientation": np.ones((2, 4))},
        {"timestamp": np.array([Trap()]), "probe.position": np.zeros((1, 3)), "probe.orientation": np.ones((1, 4))},
    ):
        np.savez(path, **arrays)
        with pytest.raises(RecordingError, match=r"x\.npz"):
            load_poses(path)
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(RecordingError, match=r"x\.npz"):
        load_poses(path)
    assert not marker.exists()


SPELLINGS = ("{!r}", "{:.25f}", "{:.30e}", "{:+.17g}", " {:.17g}", "{:.17g}\t")
"""Spellings of a number: as in JSON, with more digits than the number has, and as JSON forbids."""


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_numbers_of_a_csv_file_are_exact(tmp_path: Path, spelling: str, end: str) -> None:
    rng = np.random.default_rng(5)
    values = rng.standard_normal((3000, 3)) * 10.0 ** rng.integers(-12, 3, (3000, 3))
    values[::7] = [0.0, -0.0, -3.0]
    cells = [[spelling.format(value) for value in row] for row in values.tolist()]
    cells[14] = ["-0", "-0", "-0"]
    lines = ["t,x,y,z,qw,qx,qy,qz", *(f"{row},{','.join(cell)},1,0,0,-0" for row, cell in enumerate(cells)), ""]
    path = tmp_path / "p.csv"
    path.write_bytes(end.join(lines).encode())
    wanted = np.array([[float(cell) for cell in row] for row in cells])
    assert load_poses(path).position.tobytes() == wanted.tobytes()


def test_a_fault_in_a_long_file_is_located(tmp_path: Path) -> None:
    lines = ["t,x,y,z,qw,qx,qy,qz", *(f"{row},0.25,0.125,0.5,1,0,0,0" for row in range(20_000))]
    lines[3] = ""
    lines[15_000] += ",7"
    (tmp_path / "p.csv").write_text("\n".join(lines))
    with pytest.raises(RecordingError, match="line 15001: 9 values, but the header has 8 columns"):
        load_poses(tmp_path / "p.csv")


@pytest.mark.parametrize("count", [2, 3, 40])
def test_resampling_equals_scipy(count: int) -> None:
    poses = some_poses(count)
    samples = resample(poses, 1000.0)
    at = np.arange(len(samples)) / 1000.0
    t = poses.t - poses.t[0]
    assert at[-1] <= t[-1] < at[-1] + 0.001 + 1e-6
    position = PchipInterpolator(t, poses.position)(at) if count > 2 else None
    if position is None:
        position = np.stack([np.interp(at, t, poses.position[:, i]) for i in range(3)], axis=1)
    np.testing.assert_allclose(samples[:, :3], position, atol=1e-15)  # rounding of numbers below 0.1
    rotation = Slerp(t, Rotation.from_quat(poses.orientation[:, [1, 2, 3, 0]]))(np.minimum(at, t[-1]))
    error = rotation.inv() * Rotation.from_quat(samples[:, [4, 5, 6, 3]])
    assert error.magnitude().max() < 1e-14  # rad, rounding


def test_resampling_passes_through_the_samples() -> None:
    poses = load_poses("press-roll-spin-drag")
    samples = resample(poses, 1000.0)
    assert samples[::10, :3].tobytes() == poses.position.tobytes()
    assert samples[::10, 3:].tobytes() == poses.orientation.tobytes()


def test_rotations_take_the_short_arc_for_any_sign() -> None:
    t, half = np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.2, 0.5])
    turned = np.stack((np.cos(half), np.sin(half), 0 * half, 0 * half), axis=1)
    samples = resample(Poses(t, np.zeros((3, 3)), turned * [[1.0], [-1.0], [1.0]]), 1000.0)
    wanted = Slerp(t, Rotation.from_rotvec(np.outer(2.0 * half, (1.0, 0.0, 0.0))))(np.arange(201) / 1000.0)
    rotations = Rotation.from_quat(samples[:, [4, 5, 6, 3]])
    assert (wanted.inv() * rotations).magnitude().max() < 1e-12  # rounding


def test_resampling_rejects_too_short_and_too_long_recordings() -> None:
    still = np.zeros((2, 3)), np.array([[1.0, 0, 0, 0]] * 2)
    with pytest.raises(RecordingError, match=r"0\.5 ticks at 100 Hz"):
        resample(Poses(np.array([0.0, 0.005]), *still), 100.0)
    with pytest.raises(RecordingError, match="must be 1 to 10,000,000"):
        resample(Poses(np.array([0.0, 1e9]), *still), 1000.0)
    with pytest.raises(RecordingError, match="inf"):
        resample(Poses(np.array([-1e308, 1e308]), *still), 1000.0)


def steps(loop: np.ndarray) -> tuple[float, float, float, float]:
    """Return the largest velocity and its change per tick, linear (m/s) and angular (rad/s), over two rounds."""
    twice = np.vstack((loop, loop))
    velocity = np.diff(twice[:, :3], axis=0) * 1000.0
    rotation = Rotation.from_quat(twice[:, [4, 5, 6, 3]])
    spin = (rotation[1:] * rotation[:-1].inv()).as_rotvec() * 1000.0
    size = [np.linalg.norm(x, axis=1).max() for x in (velocity, np.diff(velocity, axis=0), spin, np.diff(spin, axis=0))]
    return float(size[0]), float(size[1]), float(size[2]), float(size[3])


def test_loop_of_an_open_motion_has_no_jump() -> None:
    k = np.arange(1001) / 1000.0
    turned = Rotation.from_rotvec(np.outer(k, [0.9, -0.4, 0.2])) * Rotation.from_rotvec([0.1, 0.2, 2.0])
    samples = np.column_stack((0.05 * k, 0.01 * np.sin(9 * k), 0 * k, turned.as_quat()[:, [3, 0, 1, 2]]))
    loop = close_loop(samples, 1000.0)
    assert loop[:1001].tobytes() == samples.tobytes()
    speed, change, spin, spin_change = steps(loop)
    assert speed < 0.1 + 2 * 0.11
    assert spin < 1.0 + 2 * 1.01
    assert change < 0.002
    assert spin_change < 0.02
    assert np.allclose(np.linalg.norm(loop[:, 3:], axis=1), 1.0, atol=1e-14)


def test_loop_of_a_closed_motion_is_not_lengthened() -> None:
    angle = np.arange(1001) / 1000.0 * 2 * np.pi
    circle = np.column_stack((np.cos(angle), np.sin(angle), 0 * angle, 0 * angle + 1, *(0 * angle,) * 3))
    circle[-1] = circle[0]
    loop = close_loop(circle, 1000.0)
    assert loop.tobytes() == circle[:-1].tobytes()
    assert steps(loop)[1] < 0.05  # centripetal: 39.5 m/s2 in a tick
