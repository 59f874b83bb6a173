"""`bench simulate` times the whole program in each format, and leaves no files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softfinger.server import cli


@pytest.mark.exhaustive
def test_bench_times_every_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each format has a time and the ratio to real time that follows from it; a figure is drawn; no file remains."""
    folder, drawing = tmp_path / "files", tmp_path / "times.svg"
    folder.mkdir()
    words = ["--ticks", "2000", "--rounds", "1", "--folder", str(folder), "--plot", str(drawing)]
    assert cli.main(["bench", "simulate", *words, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["formats"]
    assert [row["format"] for row in rows] == ["csv", "npz", "mcap"]
    for row in rows:
        assert row["times_real_time"] * row["seconds"] == pytest.approx(2.0)
        assert 0.0 < row["seconds"] <= row["median_seconds"]
        assert row["cpu_s"] > 0.0
    assert drawing.stat().st_size > 0
    assert not list(folder.iterdir())


def test_a_scene_that_one_recording_cannot_run_on_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "simulate", "--ticks", "1000", "--scene", "pinch"]) == 2
    assert "poses of" in capsys.readouterr().err
