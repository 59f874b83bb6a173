"""`check`: meaning and errors of scene and rig files, recordings that a device cannot play, and the cost of a scene."""

import json
import re
from pathlib import Path

import pytest
import trimesh
from helpers.called import called, read_stdout

from softfinger.server.verbs.check import examine_file

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


@pytest.mark.plain
@pytest.mark.parametrize("name", PRINTED)
def test_check_prints_the_content(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plate.toml").write_text(PLATE)
    output = read_stdout("check", name)
    assert [pattern for pattern in PRINTED[name] if not re.search(pattern, output)] == []


@pytest.mark.plain
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


@pytest.mark.plain
def test_check_as_json() -> None:
    result = called("check", "--json", "plane-at-60mm", "nothing-like-it")
    assert result.returncode == 2, result.stderr
    good, bad = json.loads(result.stdout)
    assert (good["kind"], good["errors"]) == ("scene", [])
    assert good["content"]["object"][0]["position_m"] == [0.0, 0.0, 0.06]
    assert bad["errors"][0].startswith("no scene, rig or experiment is named 'nothing-like-it'")


def test_explain_prints_measured_costs() -> None:
    output = read_stdout("check", "--explain", "frictionless-plane", "replay")
    passive = r"1000 N/m; passive at 1000 Hz .* more than 0\.5"
    for pattern in (r"cost of a tick.*\d+ ns", r"bare contact.*\d+ ns", passive):
        assert len(re.findall(pattern, output)) == 1, output


@pytest.mark.plain
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


@pytest.mark.plain
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


@pytest.mark.plain
@pytest.mark.parametrize("recording", ["", ".", "nothing", "none.csv", "/dev/zero"])
@pytest.mark.parametrize("driver", ["replay", "simulated"])
def test_an_unusable_recording_is_a_fault_of_the_rig(driver: str, recording: str, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(f'[device]\ndriver = "{driver}"\nrecording = "{recording}"\n')
    (fault,) = examine_file(str(rig)).errors
    assert "device.recording: " in fault and recording in fault
