"""`bench grasp`: a box that soft fingertips hold, beside MuJoCo's own contact."""

from __future__ import annotations

import json
import math
import re
import sys
from pathlib import Path

import pytest

from softfinger.server import cli
from softfinger.tools.bench import grasp_drake, grasp_mujoco

pytestmark = pytest.mark.plain


@pytest.mark.exhaustive
def test_soft_fingertips_hold_what_mujocos_contact_lets_go(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Here the box rests at m g d cos(theta) / (2 k_z); there it goes on, down and round; and it is drawn."""
    assert cli.main(["bench", "grasp", "--seconds", "1", "--json", "--plot", str(tmp_path / "grasp.svg")]) == 0
    told = json.loads(capsys.readouterr().out)
    ours, *theirs = told["contacts"]
    expected = told["expected_turn_deg"]
    assert ours["turn_deg"] == pytest.approx(expected * math.cos(math.radians(expected)), rel=0.01)
    assert abs(ours["creep_um_per_s"]) < 1.0 and abs(ours["turn_creep_deg_per_s"]) < 0.01
    assert len(theirs) == 3
    assert all(each["creep_um_per_s"] > 1.0 and each["turn_deg"] > 1.5 * expected for each in theirs)
    assert (tmp_path / "grasp.svg").stat().st_size > 1000


def test_a_time_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """With the range."""
    assert cli.main(["bench", "grasp", "--seconds", "0.1"]) == 2
    assert "1 to 1000" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("peer", "package", "wheel"), [("bullet", "pybullet", "pybullet"), ("drake", "pydrake", "drake")]
)
def test_a_peer_that_is_not_installed_says_what_to_install(
    peer: str, package: str, wheel: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is held."""
    monkeypatch.setitem(sys.modules, package, None)
    assert cli.main(["bench", "grasp", "--peer", peer]) == 2
    assert re.search(rf"--peer {peer}: .*pip install {wheel}$", capsys.readouterr().err.strip())


def test_the_picture_in_the_documentation_shows_every_peer() -> None:
    """By the names in its legend."""
    picture = (Path(__file__).parents[2] / "docs" / "figures" / "grasp.svg").read_text(encoding="utf-8")
    for name in ("softfinger", *grasp_mujoco.CONTACTS, "Bullet", *grasp_drake.CONTACTS):
        assert f">{name}<" in picture, name
