"""`bench commands` on a daemon, observed through its telemetry: no torn set of parameters, no step of force."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softfinger.server import cli
from softfinger.tools.bench.commands import FORCE_N, count_torn

pytestmark = pytest.mark.real_time


def test_bench_sees_every_set_and_no_torn_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The force returns after each change of scene, no faster than the guard allows."""
    drawing = tmp_path / "memory.svg"
    words = ["--seconds", "1", "--rate", "100", "--swaps", "1", "--plot", str(drawing)]
    assert cli.main(["bench", "commands", *words, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["set_params"] == 100
    assert content["ticks"] > 500
    assert 50 < content["changes_felt"] <= 100  # of two within a tick, which a stall of the machine makes, one is felt
    assert content["torn"] == 0
    assert content["largest_step_n"] <= content["slew_n"] * (1.0 + 1e-9)  # rounding of the sum that makes a step
    assert content["largest_step_n"] > 0.0
    assert len(content["resident_mb"]) == 1
    assert drawing.stat().st_size > 0


def test_a_torn_parameter_set_is_detected() -> None:
    """Stiffness and force of two pairs give another sum; ticks changed by the guard do not count."""
    rows = np.zeros((4, 6))
    rows[:, 2] = [FORCE_N, 1.0 + 1.5, FORCE_N, 0.5]
    rows[3, 3] = 2.0
    assert count_torn(rows) == 1
