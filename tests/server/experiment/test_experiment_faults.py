"""`softfinger check` of an experiment lists all mistakes of its file and of the files it refers to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import pytest

from softfinger.config.errors import ConfigError
from softfinger.server import cli
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment

pytestmark = pytest.mark.plain

SCENE: Final = """
[fingertip]
radius_m = RADIUS
[[object]]
name = "table"
shape = "plane"
[object.material]
stiffness_n_per_m = 500.0
damping_ns_per_m = DAMPING
"""
RIG: Final = '[device]\ndriver = "DRIVER"\n[servo]\nrate_hz = RATE\n'
EXPERIMENT: Final = """
title = "t"
scene = "scene.toml"
rig = "rig.toml"

[task]
kind = "compare"
parameter = "object.table.material.stiffness_n_per_m"
reference = 500.0
question = "Which was stiffer?"

[procedure]
kind = "constant"
levels = [0.1, 1.0]

[[factor]]
name = "damping"
parameter = "object.table.material.damping_ns_per_m"
levels = [0.0, 1.0]

[design]
seed = SEED

[overrides]
"OVERRIDE" = 1.0

[motion]
FINGER = [[0.0, 0.0, 0.0, 0.01]]

[screen]
image = "none.png"
by = { "3.0" = { colour = "#ffffff" } }

[observer]
by = { "2.0" = { threshold = 0.2 } }
answers = { weight = 60.0 }

[[survey]]
name = "tlx"
at = ["after"]
file = "SURVEY"
"""


PLAIN: Final = """
title = "t"
scene = "scene.toml"
task = { kind = "compare", parameter = "coupling.damping_ns_per_m", reference = 1.0, question = "?" }
procedure = { kind = "constant", levels = [0.1] }
design = { seed = 1 }
"""


def check(folder: Path, capsys: pytest.CaptureFixture[str], **values: str) -> list[str]:
    sound = {"SEED": "1", "OVERRIDE": "object.table.material.damping_ns_per_m", "FINGER": "fingertip", "RADIUS": "0.01",
             "DAMPING": "0.0", "DRIVER": "simulated", "RATE": "1000.0", "SURVEY": "nasa-tlz"}  # fmt: skip
    for name, text in (("scene.toml", SCENE), ("rig.toml", RIG), ("study.toml", EXPERIMENT)):
        for word, value in (sound | values).items():
            text = text.replace(word, value)
        (folder / name).write_text(text)
    capsys.readouterr()
    cli.main(["check", "--json", str(folder / "study.toml")])
    errors: list[str] = json.loads(capsys.readouterr().out)[0]["errors"]
    return errors


def assert_lists(errors: list[str], *texts: str) -> None:
    matches = [[text for text in texts if text in error] for error in errors]
    assert sorted(matches) == sorted([text] for text in texts), errors


NAMES: Final = ("'nasa-tlz'", "observer.by", "screen.by", "screen.image = 'none.png'")


def test_mistakes_of_other_files_and_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert_lists(check(tmp_path, capsys), *NAMES)
    assert_lists(check(tmp_path, capsys, SURVEY="nasa-tlx"), *NAMES[1:], "observer.answers.weight")
    errors = check(tmp_path, capsys, OVERRIDE="object.tabel.position_m", FINGER="thumb", DRIVER="simulatd")
    assert_lists(errors, "simulatd", "object.tabel", "motion.thumb", *NAMES)


def test_mistakes_behind_mistakes_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    errors = check(tmp_path, capsys, SEED="-1", RADIUS="-0.01", DAMPING="-2.0", RATE="0.0", FINGER="thumb")
    assert_lists(errors, "design.seed", "servo.rate_hz", "fingertip.radius_m", "damping_ns_per_m = -2.0", *NAMES)
    with pytest.raises(ConfigError, match=r"8 faults:\n(.*\n){7}.*"):
        Experiment(tmp_path / "study.toml")


@pytest.mark.parametrize(
    ("name", "data", "more", "table"),
    [
        ("blob.obj", b"v 0 0 0\nv .04 0 0\nv 0 .04 0\nv 0 0 .04\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n", b"# more\n",
         '[[object]]\nname = "blob"\nshape = "mesh"\nfile = "blob.obj"\nposition_m = [0.0, 0.0, -1.0]\n'
         'material = "wood"\n'),
        ("ribs.csv", b"0,1\n1,0\n", b"0,1\n",
         '[object.texture]\nfile = "ribs.csv"\nsize_m = [0.02, 0.02]\nheight_m = 1e-5\n'),
        ("box.xml", b'<mujoco><worldbody><geom size=".01" pos="0 0 -1"/></worldbody></mujoco>', b"<!-- more -->",
         '[world]\nmodel = "box.xml"\nmaterial = "wood"\n'),
    ],
    ids=["mesh", "texture", "model"],
)  # fmt: skip
def test_a_file_that_a_scene_names_belongs_to_the_study(
    name: str, data: bytes, more: bytes, table: str, tmp_path: Path
) -> None:
    folder, offline = tmp_path / "study", RunOptions(dry_run=True, no_daemon=True)
    folder.mkdir()
    (folder / name).write_bytes(data)
    sound = {"RADIUS": "0.01", "DAMPING": "0.0"}
    scene = SCENE
    for word, value in sound.items():
        scene = scene.replace(word, value)
    (folder / "scene.toml").write_text(scene + table)
    (folder / "study.toml").write_text(PLAIN)
    Experiment(folder / "study.toml").run(tmp_path / "out", 1, offline)
    Experiment(folder / "study.toml").run(tmp_path / "out", 2, offline)
    (folder / name).write_bytes(data + more)
    with pytest.raises(ConfigError, match=rf"files\.json: .* other values \({name}\)"):
        Experiment(folder / "study.toml").run(tmp_path / "out", 3, offline)
