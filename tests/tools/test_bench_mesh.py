"""`bench mesh` on small balls reports correct numbers; times are not asserted."""

import json
from pathlib import Path

import pytest

from softfinger.server.cli import main


@pytest.mark.exhaustive
def test_small_balls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--levels", "3", "--ticks", "1000", "--paced", "1000", "--json", "--plot", str(tmp_path / "cost.png")]
    assert main(["bench", "mesh", *words]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["triangles"], row["bumpy"]) for row in rows] == [(1280, False), (1280, True)]
    for row in rows:
        assert row["distance_error_m"] < 1e-9 * 0.1
        assert 1.0 <= row["asked"]["p50"] <= row["asked"]["max"] < 1280
    assert (tmp_path / "cost.png").stat().st_size > 1000
