"""No verb overwrites its input, a recording, or the output of another finger."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from helpers.called import called
from helpers.programs import run_program

POSES = "t,x,y,z,qw,qx,qy,qz\n0,0,0,0.02,1,0,0,0\n0.1,0,0,0.009,1,0,0,0\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_text(POSES)
    (tmp_path / "link.csv").symlink_to("a.csv")
    return tmp_path


@pytest.mark.parametrize("written", ["a.csv", "./a.csv", "link.csv"])
@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "--scene", "paper-plane", "--poses", "a.csv", "--out"],
        ["import", "a.csv", "--columns", "t,x,y,z", "--out"],
        ["export", "a.csv", "--out"],
        ["run", "--endpoint", "tcp://127.0.0.1:*", "--recording", "a.csv", "--once", "--forces"],
    ],
    ids=lambda words: words[0],
)
def test_an_output_may_not_be_an_input(words: list[str], written: str, folder: Path) -> None:
    result = called(*words, written)
    assert result.returncode == 2 and "choose another output file" in result.stderr, result.stderr
    assert (folder / "a.csv").read_text() == POSES and sorted(os.listdir(folder)) == ["a.csv", "link.csv"]


@pytest.mark.real_time
def test_a_recording_overwrites_no_file(endpoints: tuple[str, str], folder: Path) -> None:
    to = ["--endpoint", endpoints[0], "--timeout", "60"]
    result = called("record", "a.csv", "--duration", "0.05", *to)
    assert result.returncode == 3 and "already exists" in result.stderr and (folder / "a.csv").read_text() == POSES
    result = called("record", "short.csv", "--duration", "0.0005", *to)
    assert result.returncode == 3 and "at least 2" in result.stderr and not (folder / "short.csv").exists()
    result = called("record", "--poses", "index=b.csv", "--poses", "thumb=./b.csv", *to)
    assert result.returncode == 2 and "are the same file" in result.stderr and not (folder / "b.csv").exists()
    assert called("record", "b.csv", "--duration", "0.05", *to).returncode == 0 and (folder / "b.csv").stat().st_size


def test_a_name_that_the_terminal_cannot_encode_is_escaped(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    table = 'name = "стол"\nshape = "plane"\nmaterial = "rubber"\n'
    scene.write_text(f"[fingertip]\nradius_m = 0.01\n[[object]]\n{table}", "utf-8")
    words = [sys.executable, "-m", "softfinger.server.cli", "check", str(scene)]
    result = run_program(words, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert (
        result.returncode == 0 and "\\u0441\\u0442\\u043e\\u043b" in result.stdout and "Traceback" not in result.stderr
    )
