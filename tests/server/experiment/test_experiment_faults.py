"""`softfinger check` of an experiment: every mistake in one pass, of the file and of what it names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import pytest

from softfinger.config.errors import ConfigError
from softfinger.server import cli
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


def check(folder: Path, capsys: pytest.CaptureFixture[str], **values: str) -> list[str]:
    """Return the errors that `check --json` lists of an experiment whose words are replaced by `values`."""
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
    """Assert that each error has one of the texts, and each text is in one error."""
    found = [[text for text in texts if text in error] for error in errors]
    assert sorted(found) == sorted([text] for text in texts), errors


NAMES: Final = ("'nasa-tlz'", "observer.by", "screen.by", "screen.image = 'none.png'")


def test_mistakes_of_other_files_and_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each once, though the conditions, levels and touches repeat the overrides."""
    assert_lists(check(tmp_path, capsys), *NAMES)
    assert_lists(check(tmp_path, capsys, SURVEY="nasa-tlx"), *NAMES[1:], "observer.answers.weight")
    found = check(tmp_path, capsys, OVERRIDE="object.tabel.position_m", FINGER="thumb", DRIVER="simulatd")
    assert_lists(found, "simulatd", "object.tabel", "motion.thumb", *NAMES)


def test_mistakes_behind_mistakes_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong number hides no other mistake; scene and rig list all of theirs."""
    found = check(tmp_path, capsys, SEED="-1", RADIUS="-0.01", DAMPING="-2.0", RATE="0.0", FINGER="thumb")
    assert_lists(found, "design.seed", "servo.rate_hz", "fingertip.radius_m", "damping_ns_per_m = -2.0", *NAMES)
    with pytest.raises(ConfigError, match=r"8 faults:\n(.*\n){7}.*"):
        Experiment(tmp_path / "study.toml")
