"""Device reports contain no personal data, and answer the questions of the form; analysis of their rows: motions,
rotations, noise, pushes."""

import math
import platform
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from helpers.forgotten import forget_user
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from softfinger.config.load import load_rig
from softfinger.drivers import registry
from softfinger.drivers.base import SAMPLE_BUTTONS
from softfinger.tools.doctor import motions, privacy, report
from softfinger.tools.doctor.questions import ANSWERS, answer_questions, load_questions
from softfinger.tools.exchange import FORCE, ROW_SIZE, SAMPLE

pytestmark = pytest.mark.plain

USER: Final = "zaphodb"


@pytest.fixture
def somebody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> privacy.Redactor:
    monkeypatch.setenv("HOME", f"/home/{USER}")
    monkeypatch.setenv("USER", USER)
    (tmp_path / "My Project").mkdir()
    monkeypatch.chdir(tmp_path / "My Project")
    return privacy.Redactor(["SN-4711-A"])


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        (f"/home/{USER}/lib/x.so", "x.so"),
        (f"/home/{USER}", "~"),
        (f"/media/{USER}/disk", "..."),
        (f"/home/{USER}/Project-X/scene.toml: no such file", "scene.toml: no such file"),
        ("~/Project-X/scene.toml, ~/Project-X", "scene.toml, ..."),
        ("Project-X/part/scene.toml:12", "scene.toml:12"),
        ("../Project-X/scene.toml", "scene.toml"),
        ("no file '/srv/Project X/scene.toml'", "no file 'scene.toml'"),
        ("PATH=/srv/Project-X/bin:/usr/bin", "PATH=...:/usr/bin"),
        ("ipc:///srv/Project-X/commands", "ipc://..."),
        ("/run/media/me/Project-X/a.csv", "a.csv"),
        (f"sudo setcap x {sys.prefix}/bin/python", "sudo setcap x <environment>/bin/python"),
        (f"{Path(privacy.__file__).parent}/privacy.py", "softfinger/tools/doctor/privacy.py"),
        ("tcp://127.0.0.1:5555, https://example.org/a/b.zip", "tcp://127.0.0.1:5555, https://example.org/a/b.zip"),
        ("docs/operate/docker.md, 3 N/m, 1/s.", "docs/operate/docker.md, 3 N/m, 1/s."),
        ("/sys/class/x.y, /dev/hidraw0", "/sys/class/x.y, /dev/hidraw0"),
        (f"held by {USER}", "held by <user>"),
        (f"{USER}x is another word", f"{USER}x is another word"),
        ("omega.3, serial 1234", "omega.3, serial ...34"),
        ("no HID device has the serial number 'SN42'", "no HID device has the serial number '...42'"),
        ("attached is SN-4711-A here", "attached is ...-A here"),
        ("/dev/serial/by-id/usb-PJRC_Teensy_123456-if00", "/dev/serial/by-id/..."),
        ("a serial line at 115200", "a serial line at 115200"),
        ("serial 16c0:0483 at /dev/pts/0", "serial 16c0:0483 at /dev/pts/0"),
    ],
)
def test_identifying_words_are_removed(text: str, clean: str, somebody: privacy.Redactor) -> None:
    assert somebody.text(text) == clean


def test_all_of_a_report_is_cleaned_but_the_words_of_the_program(somebody: privacy.Redactor) -> None:
    dirty = {"driver": USER, "a": [USER, {"b": f"on {platform.node()}"}], USER: 1.5, "none": None}
    assert somebody.clean(dirty) == {"driver": USER, "a": ["<user>", {"b": "on <host>"}], USER: 1.5, "none": None}


def test_options_contain_no_folder() -> None:
    options = {"firmware": "/srv/lab/x.bin", "serial": 123456, "path": "/dev/hidraw0", "hand": {"recording": "a/b.csv"}}
    want = {"firmware": "x.bin", "serial": "...56", "path": "/dev/hidraw0", "hand": {"recording": "b.csv"}}
    assert privacy.redact_options(options) == want


def test_a_working_folder_with_a_space_is_removed(somebody: privacy.Redactor) -> None:
    assert somebody.text(f"{Path.cwd()}/part/x.toml: fault; {Path.cwd()} is full") == "x.toml: fault; . is full"


def test_scenes_and_rigs_contain_no_folder(somebody: privacy.Redactor) -> None:
    dirty = {"object": [{"file": "My Project/a.obj"}], "world": {"model": "Project-X/m"}, "directory": "Project-X"}
    want = {"object": [{"file": "a.obj"}], "world": {"model": "m"}, "directory": "..."}
    assert somebody.clean(dirty) == want and somebody.clean({"directory": "."}) == {"directory": "."}


def test_a_user_without_a_home_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    forget_user(monkeypatch)
    assert privacy.Redactor().text("~ and /srv/x/y.toml") == "~ and y.toml"


def test_the_questions_are_well_formed() -> None:
    ids = [question.id for question in load_questions()]
    assert len(set(ids)) == len(ids)
    drivers = {driver for question in load_questions() for driver in question.drivers}
    assert drivers <= set(registry.list_names()) and not drivers & {"replay", "simulated"}
    assert ANSWERS.keys() <= set(ids)


def test_measurements_answer_their_questions() -> None:
    empty, _ = report.start_report(load_rig("falcon"), guided=False)
    assert not any(row["measured"] for row in answer_questions(empty))
    full = empty | {
        "moves": [{"asked": "move it up", "kind": "translation", "seen": "+z"}],
        "pushes": [{"axis": "+x", "seen": "-x"}],
        "buttons": {"masks": [0, 4]},
    }
    answers = {row["id"]: row["answer"] for row in answer_questions(full) if row["measured"]}
    assert answers == {
        "frame": "move it up: +z", "force-sign": "force along +x: -x", "buttons": "masks 0, 4 were seen"
    }  # fmt: skip


RATE_HZ: Final = 1000.0


def poses(position: np.ndarray, orientation: np.ndarray | None = None) -> np.ndarray:
    """Rows with these positions (n, 3) m and orientations (n, 4)."""
    rows = np.zeros((len(position), ROW_SIZE))
    rows[:, SAMPLE : SAMPLE + 3] = position
    rows[:, SAMPLE + 3 : SAMPLE + 7] = (1.0, 0.0, 0.0, 0.0) if orientation is None else orientation
    return rows


@pytest.mark.parametrize(
    ("direction", "motion"),
    [
        ((0.03, 0.005, 0.0), "+x"),
        ((0.0, -0.04, 0.01), "-y"),
        ((0.001, 0.0, 0.02), "+z"),
        ((0.003, 0.0, -0.004), "no motion"),
        ((0.02, 0.02, 0.0), "not along one axis"),
    ],
)
def test_a_motion_has_an_axis_and_a_sense(direction: tuple[float, float, float], motion: str) -> None:
    share = np.clip(np.linspace(-0.5, 1.5, 1000), 0.0, 1.0)[:, None]
    path = share * np.array(direction) + np.sin(np.pi * share) * np.array([0.0, 0.0, 0.05])
    result = motions.move("ask", "translation", "+x", poses(path))
    assert result["seen"] == motion and result["agrees"] == (motion == "+x")
    np.testing.assert_allclose(result["vector"], direction, atol=1e-12)  # rounding of a median


def test_a_turn_is_the_rotation_between_first_and_last() -> None:
    """In the world frame as scipy's, for any initial orientation and any sign of a quaternion."""
    start = Rotation.from_rotvec([0.3, -0.2, 0.5])
    turn = np.array([0.05, -0.02, 0.6])
    ways = [Rotation.from_rotvec(share * turn) * start for share in np.linspace(0.0, 1.0, 50)]
    orientation = np.array([np.roll(rotation.as_quat(), 1) for rotation in ways])  # scipy has w last
    orientation[25:] *= -1.0
    result = motions.move("ask", "rotation", "+z", poses(np.zeros((50, 3)), orientation))
    np.testing.assert_allclose(result["vector"], turn, atol=1e-12)  # rounding of products
    assert result["seen"] == "+z" and result["unit"] == "rad"


def test_noise_at_rest_and_range_of_known_rows() -> None:
    random = np.random.default_rng(1)
    rows = poses(random.normal(size=(100_000, 3)) * (1e-6, 2e-6, 3e-6) + np.array([0.0, 0.01, 0.0]))
    rows[7, SAMPLE] = math.nan
    result = motions.measure_rest(rows, turns=False)
    assert result["not_finite"] == 1
    # of 1e5 samples a deviation is known to 1/sqrt(2e5), 0.2 %: five times that
    np.testing.assert_allclose(result["position_std_m"], (1e-6, 2e-6, 3e-6), rtol=0.011)
    assert result["rotation_std_rad"] is None
    span = motions.reach(rows)
    assert span is not None and span["position_min_m"][1] < 0.01 < span["position_max_m"][1]
    assert motions.measure_rest(rows[7:8], turns=False) is None
    rows[:3, SAMPLE + SAMPLE_BUTTONS] = (4.0, 1.0, 4.0)
    assert motions.list_masks(rows) == [0, 1, 4]


def pushed_rows(sign: float, mass: float, damping: float, stiffness: float) -> np.ndarray:
    seconds, hertz = 3.0, 1.0
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ

    def force(at: Any) -> Any:
        return np.sin(math.pi * at / seconds) ** 2 * np.sin(2.0 * math.pi * hertz * at)

    def slope(at: float, state: np.ndarray) -> list[float]:
        return [state[1], (sign * force(at) - damping * state[1] - stiffness * state[0]) / mass]

    travel = solve_ivp(slope, (0.0, seconds), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-12).y[0]
    rows = poses(np.stack([np.zeros_like(travel), travel, np.zeros_like(travel)], axis=1))
    rows[:, FORCE + 2] = force(t)
    return rows


@pytest.mark.parametrize(
    ("holding", "plus", "minus"),
    [
        ((0.2, 5.0, 500.0), "+y", "free handle, or the wrong sign"),  # a hand that springs back
        ((0.2, 40.0, 100.0), "+y", "-y"),  # a soft hand
        ((0.3, 10.0, 1e-6), "+y", "-y"),  # a handle that is braked only
        ((2.0, 0.1, 1e-6), "free handle, or the wrong sign", "+y"),  # a free mass: an answer needs a hand
    ],
)  # fmt: skip
def test_a_push_shows_axis_and_sign(holding: tuple[float, float, float], plus: str, minus: str) -> None:
    for sign, motion in ((1.0, plus), (-1.0, minus)):
        result = motions.push(2, 1.0, RATE_HZ, pushed_rows(sign, *holding))
        assert result["axis"] == "+z" and result["moved_axis"] == "y"
        assert motion in result["seen"], result
        assert result["share"] > 0.8  # a free mass also drifts off, which is not a part of the fit


def test_a_motion_of_the_hand_is_not_counted_as_a_push() -> None:
    rows = pushed_rows(1.0, 0.2, 5.0, 500.0)
    rows[:, SAMPLE] = 0.02 * np.sin(2.0 * math.pi * 2.7 * np.arange(len(rows)) / RATE_HZ)
    result = motions.push(2, 1.0, RATE_HZ, rows)
    assert result["seen"].startswith(("not clear", "+y"))
    rows[:, SAMPLE + 1] = 0.0
    result = motions.push(2, 1.0, RATE_HZ, rows)
    assert result["seen"].startswith("not clear")
    rows[:, SAMPLE] = 0.0
    assert motions.push(2, 1.0, RATE_HZ, rows)["seen"] == "no motion"
    rows[:, FORCE + 2] = 0.0
    assert motions.push(2, 1.0, RATE_HZ, rows) is None
