"""`check`: meaning and errors of scene and rig files, recordings that a device cannot play, and the cost of a scene; of
a rig and a scene: position of the soft wall relative to the objects, as text and as a figure."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import paper_mapping
from helpers.called import called, read_stdout

from softfinger.config.load import build
from softfinger.config.schema import Scene, Workspace
from softfinger.drivers.kinematics.subspace import MotionSubspace
from softfinger.server.offline import workspace
from softfinger.server.verbs.check import examine_file

pytestmark = pytest.mark.plain

PLATE = """
[fingertip]
radii_m = [0.008, 0.007, 0.012]
orientation_wxyz = [0.8, 0.6, 0.0, 0.0]
[[object]]
name = "plate"
shape = "plane"
material = { stiffness_n_per_m = 1000.0, normal = { exponent = 1.5 } }
motion = { kind = "sinusoid", translation_m = [0.0, 0.0, 0.001], frequency_hz = 2.0 }
"""
PRINTED = {
    "paper-plane": (
        "paper-plane: scene, usable", "rolling +euler_zxz, torque stiffness 1000 N/m",
        r"friction +static 0\.6, kinetic 0\.5",
    ),
    "frictionless-plane": ("rolling +absent", "friction +absent: frictionless"),
    "replay": ("replay: rig, usable", "servo +1000 Hz, real time auto"),
    "plate.toml": (
        r"ellipsoid, radii .*0\.008.* m, turned by .*0\.8", r"normal force +.*exponent 1\.5",
        "motion sinusoid +.*frequency_hz 2",
    ),
    # 82 trials of two touches, each of 2 s after a gap of 0.3 s.
    "stiffness-discrimination": ("lasts +6 min and the answers, a break after each 40 trials",),
    "curvature-by-rolling": (r"conditions +rolls; slides\n +trials +102, 2 of them practice; questplus",),
}  # fmt: skip
"""Effects that are modelled or omitted, shapes, laws, motions, and trials."""


@pytest.mark.parametrize("name", PRINTED)
def test_check_prints_the_content(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plate.toml").write_text(PLATE)
    output = read_stdout("check", name)
    assert [pattern for pattern in PRINTED[name] if not re.search(pattern, output)] == []


def test_check_reports_every_faulty_file(tmp_path: Path) -> None:
    (tmp_path / "both.toml").write_text("[fingertip]\n[device]\n")
    (tmp_path / "neither.toml").write_text("[hello]\n")
    paths = [str(tmp_path / f"{name}.toml") for name in ("both", "neither")]
    result = called("check", *paths, "replay", "repaly")
    assert result.returncode == 2 and "replay: rig, usable" in result.stdout
    for part in (
        "both.toml: not usable\n  both scene (fingertip) and rig (device)",
        "neither.toml: not usable\n  neither scene nor rig",
        "no scene, rig or experiment is named 'repaly' (did you mean 'replay'?)",
    ):
        assert part in result.stderr


def test_check_as_json() -> None:
    result = called("check", "--json", "plane-at-60mm", "nothing-like-it")
    assert result.returncode == 2, result.stderr
    good, bad = json.loads(result.stdout)
    assert (good["kind"], good["errors"]) == ("scene", [])
    assert good["content"]["object"][0]["position_m"] == [0.0, 0.0, 0.06]
    assert bad["errors"][0].startswith("no scene, rig or experiment is named 'nothing-like-it'")


def test_check_prints_how_geoms_are_used(tmp_path: Path) -> None:
    trimesh.creation.box((20.0, 20.0, 20.0)).export(tmp_path / "cube.stl")
    geom = '<body pos="{k} 0 1"><freejoint/><geom name="geom {k}" type="mesh" mesh="cube"/></body>'
    (tmp_path / "cubes.xml").write_text(
        '<mujoco><option timestep="0.001"/><asset><mesh name="cube" file="cube.stl" scale="0.001 0.001 0.001"/>'
        '<hfield name="hills" nrow="2" ncol="3" size="0.2 0.1 0.05 0.01" elevation="0 1 2 1 0 1"/></asset>'
        '<worldbody><geom name="hills" type="hfield" hfield="hills"/>'
        f"{''.join(geom.format(k=k) for k in range(10))}</worldbody></mujoco>"
    )
    scene = '[fingertip]\nradius_m = 0.008\n[world]\nmodel = "cubes.xml"\n'
    (tmp_path / "cubes.toml").write_text(scene + "material = { stiffness_n_per_m = 500.0 }\n")
    output = read_stdout("check", str(tmp_path / "cubes.toml"))
    assert "11 of 11 geoms touched" in output
    assert re.search(r"map +3 x 2 pixels, .* heights 0 to 0\.05 m", output)


def test_an_error_does_not_hide_errors_of_other_parts(tmp_path: Path) -> None:
    files = {
        "scene": """
            fingertip = { radius_m = -1 }
            world = { model = "none.xml" }
            object = [
                { name = "one", shape = "mehs", file = "one.stl", material = "wood" },
                { name = "two", shape = "mesh", file = "two.dae", material = "wood" },
                { name = "three", shape = "mesh", file = "three.stl", material = "wood" }
            ]""",
        "rig": """
            servo = { rate_hz = 99 }
            [devices.thumb]
            driver = "seriall"
            [devices.index]
            driver = "replay"
            recordin = "x"
            [devices.middle]
            driver = "replay"
            recording = "none.csv\"""",
    }
    for name, text in files.items():
        (tmp_path / f"{name}.toml").write_text(text)
    (tmp_path / "three.stl").write_bytes(b"solid")
    scene, rig = (examine_file(str(tmp_path / f"{name}.toml")).errors for name in files)
    expected = {
        "fingertip.radius_m = -1": scene, "'mehs'": scene, "one.stl: cannot be read": scene, "none.xml: cannot": scene,
        "'two.dae': must end in": scene, "three.stl: has no endsolid at its end": scene,
        "servo.rate_hz = 99": rig, "did you mean 'serial'": rig, "did you mean 'recording'": rig,
        "recording is missing": rig, "devices.middle.recording: ": rig,
    }  # fmt: skip
    assert [part for part, errors in expected.items() if sum(part in error for error in errors) != 1] == []
    assert len(scene) == 6 and len(rig) == 5


def test_an_error_names_its_file_once(tmp_path: Path) -> None:
    file = tmp_path / "missing.toml"
    result = called("check", str(file))
    assert result.returncode == 2 and result.stderr == f"{file}: not usable\n  no such file\n"


@pytest.mark.parametrize("recording", ["", ".", "nothing", "none.csv", "bad.csv", "/dev/zero"])
@pytest.mark.parametrize("driver", ["replay", "simulated"])
def test_an_unusable_recording_is_a_fault_of_the_rig(driver, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bad.csv").write_text("t,x\n")
    Path("rig.toml").write_text(f'[device]\ndriver = "{driver}"\nrecording = "{recording}"\n')
    (fault,) = examine_file("rig.toml").errors
    assert "device.recording: " in fault and recording in fault


SPHERE = Workspace(radius_m=0.04, center_m=(0.01, 0.0, 0.02))
BOX = Workspace(size_m=(0.1, 0.06, 0.08))
STEP_M = 1e-3
"""Spacing of the points on a drawn sphere, and the error of its chords."""


def make_scene(**ball: object) -> Scene:
    table = {"name": "ball", "shape": "sphere", "radius_m": 0.01, **ball}
    return build(Scene, paper_mapping(table=table, material={"torsion": None}), "test scene")


@pytest.mark.parametrize(
    ("place", "description"),
    [
        ((0.01, 0.0, 0.02), "inside"),
        ((0.05, 0.0, 0.02), "inside and outside"),
        ((0.08, 0.0, 0.02), "outside: its nearest point is 20 mm behind the wall"),  # 70 mm away, less 40 and 10
    ],
)
def test_objects_are_described_relative_to_the_wall(place: tuple[float, float, float], description: str) -> None:
    objects = workspace.place_objects(SPHERE, make_scene(position_m=list(place)))
    assert workspace.make_rows(SPHERE, objects) == [("1 'ball'", description)]
    away = workspace.compute_signed_distance(SPHERE, objects[0].points)
    apart = float(np.linalg.norm(np.array(place) - np.array(SPHERE.center_m)))
    assert away.max() == pytest.approx(apart + 0.01 - 0.04, abs=STEP_M)
    assert away.min() == pytest.approx(abs(apart - 0.01) - 0.04, abs=STEP_M) or apart < 0.01


def test_signed_distance_of_a_box() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.08, 0.07, 0.0], [0.045, 0.0, 0.0]])
    assert workspace.compute_signed_distance(BOX, points) == pytest.approx([-0.03, 0.01, 0.05, -0.005])


def test_text_draws_wall_and_objects_to_scale() -> None:
    turned = make_scene(position_m=[0.01, 0.03, 0.02], orientation_wxyz=[0.0, 1.0, 0.0, 0.0])
    lines = workspace.draw_text(SPHERE, workspace.place_objects(SPHERE, turned))
    assert lines[0].startswith("from the front: x to the right, z up; 100 mm wide")
    middle = lines[1 + workspace.ROWS // 2].ljust(2 * workspace.COLUMNS + 3)
    front, right = middle[: workspace.COLUMNS], middle[-workspace.COLUMNS :]
    cell = 100.0 / (workspace.COLUMNS - 1)
    assert len(front.strip()) == 2 * int(40.0 / cell) + 1
    # From the front the ball is in the middle; from the right 20 to 40 mm to the right of it.
    assert [k - workspace.COLUMNS // 2 for k, c in enumerate(front) if c == "1"] == [*range(-5, 0), *range(1, 6)]
    positions_mm = [cell * (k - workspace.COLUMNS // 2) for k, c in enumerate(right) if c == "1"]
    assert min(positions_mm) == pytest.approx(20.0, abs=cell) and max(positions_mm) == pytest.approx(40.0, abs=cell)


def test_the_command_line_draws_each_rig_in_each_scene(tmp_path: Path) -> None:
    picture = tmp_path / "wall.svg"
    output = read_stdout("check", "falcon", "paper-plane", "--plot", str(picture))
    assert "the soft wall of falcon in paper-plane\n  1 'table'  inside and outside\n" in output
    assert "1" * (workspace.COLUMNS // 2) + "+" + "1" * (workspace.COLUMNS // 2) in output
    drawing = picture.read_text()
    assert "soft wall" in drawing and "table" in drawing and "from the right" in drawing
    assert "the soft wall of" not in read_stdout("check", "falcon")


def test_reachable_curve_is_the_arc_or_plane_inside_the_workspace() -> None:
    """A plane cuts a sphere in a circle or misses it; points of an arc have the handle's length as radius."""
    normal, up = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    for away, radius in ((0.0, 0.04), (0.024, 0.032), (0.05, None)):
        point = np.array([0.3, away, -0.2])  # anywhere in the plane
        points = workspace.compute_reachable_curve(SPHERE, MotionSubspace(2, normal, point, point))
        if radius is None:
            assert len(points) == 0
            continue
        np.testing.assert_allclose(points[:, 1], away, atol=1e-15)
        sizes = np.linalg.norm(points - (0.01, away, 0.02), axis=1)
        np.testing.assert_allclose(sizes, radius, atol=0.08 / (workspace.DIRECTIONS - 1))  # steps of the search
    middle = np.array([0.01, 0.0, 0.02])
    points = workspace.compute_reachable_curve(SPHERE, MotionSubspace(1, normal, middle - 0.09 * up, middle))
    np.testing.assert_allclose(np.linalg.norm(points - middle + 0.09 * up, axis=1), 0.09, atol=1e-15)
    # the end of a chord of 40 mm from the middle: 2 asin(20 / 90)
    assert points[:, 0].max() - 0.01 == pytest.approx(0.09 * np.sin(2.0 * np.arcsin(0.02 / 0.09)), abs=STEP_M)


def test_the_plane_of_a_device_is_drawn() -> None:
    output = read_stdout("check", "haply-2diy", "paper-plane")
    assert "edge of the plane in which the handle moves; other forces are not displayed" in output
    begins = 2 + workspace.COLUMNS + 3
    drawn = output.partition("the soft wall of")[2].splitlines()
    views = [line for line in drawn if workspace.CURVE_MARK in line and "handle" not in line]
    places = {k for line in views for k, c in enumerate(line[begins:]) if c == workspace.CURVE_MARK}
    assert places == {workspace.COLUMNS // 2}
    assert all(line[:begins].count(workspace.CURVE_MARK) >= 2 for line in views)
