"""`bench view`: each case has its ticks and viewers, and pages are counted in a real browser."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import why_none

from softfinger.config.errors import ConfigError
from softfinger.server import cli
from softfinger.tools.bench.view import TurnResult, summary

pytestmark = pytest.mark.real_time


@pytest.mark.exhaustive
@pytest.mark.skipif(bool(why_none()), reason=why_none())
def test_bench_measures_every_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ticks went on in all; a viewer has used a processor, a page has drawn; a figure is there."""
    drawing = tmp_path / "late.svg"
    words = ["--viewers", "2", "--browsers", "1", "--seconds", "1", "--plot", str(drawing)]
    assert cli.main(["bench", "view", *words, "--json"]) == 0
    cases = json.loads(capsys.readouterr().out)["cases"]
    assert list(cases) == ["no viewer", "1 viewer", "2 viewers", "1 page"]
    assert all(case["ticks"] > 100 for case in cases.values())
    assert cases["no viewer"]["viewer_load"] == 0.0 < cases["1 viewer"]["viewer_load"]
    assert [case["frames_per_s"] is None for case in cases.values()] == [True, True, True, False]
    assert cases["1 page"]["frames_per_s"]["least"] > 0.0
    assert drawing.stat().st_size > 0


def test_a_page_that_cannot_be_opened_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """No viewers at all are no measurement, and pages need a Chromium."""
    monkeypatch.setenv("PATH", "/nowhere")
    assert cli.main(["bench", "view", "--browsers", "1"]) == ConfigError.exit_code
    assert cli.main(["bench", "view", "--viewers", "0"]) == ConfigError.exit_code


def test_misses_are_counted_among_the_ticks_that_were_due() -> None:
    """Of two turns with 2 misses each and 3 ticks each, 4 of 10 were missed; frames are the least and the median."""
    ticks = np.array([[1e-5, 1e-4, 5.0], [1e-5, 1e-4, 5.0], [1e-5, 1e-4, 7.0]])
    result = summary([TurnResult(ticks, 0.1, [20.0, 40.0]), TurnResult(ticks, 0.3, [30.0])])
    assert result["missed_of_1000"] == pytest.approx(400.0)
    assert result["viewer_load"] == pytest.approx(0.2)
    assert result["frames_per_s"] == {"least": 20.0, "median": 30.0}
