"""`bench`: results of each measurement on small cases; times are not asserted."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import why_none
from helpers.processes import COMMAND
from helpers.programs import run_program

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_rig, load_scene
from softfinger.server.cli import main
from softfinger.server.wire.client import NoTelemetry
from softfinger.tools.bench.commands import FORCE_N, count_torn
from softfinger.tools.bench.loop import open_devices
from softfinger.tools.bench.soak import SoakResult, compute_growth, evaluate
from softfinger.tools.bench.telemetry import run_source
from softfinger.tools.bench.view import TurnResult, summarize_turns


def small(line: str, part: str, *marks: pytest.MarkDecorator) -> Any:
    return pytest.param(line, part, marks=[pytest.mark.exhaustive, *marks], id=line.split()[0])


@pytest.mark.parametrize(
    ("line", "part"),
    [
        pytest.param("loop --seconds 0.3 --realtime off", "servo", id="loop"),
        small("telemetry --seconds 0.5 --subscribers 2", "daemon"),
        small("mesh --levels 3 --ticks 1000 --paced 1000", "rows"),
        small("simulate --ticks 2000 --rounds 1", "formats"),
        small("closed-loop --blocks 3", "plants"),
        small("soak --minutes 0.2", "processes", pytest.mark.real_time),
        small("view --viewers 2 --browsers 1 --seconds 1", "cases", pytest.mark.real_time,
              pytest.mark.skipif(bool(why_none()), reason=why_none())),
    ],
)  # fmt: skip
def test_a_measurement_is_printed_and_drawn(line: str, part: str, tmp_path: Path) -> None:
    plot = tmp_path / "plot.png"
    completed = run_program([*COMMAND, "bench", *line.split(), "--json", "--plot", str(plot)], cwd=tmp_path)
    assert completed.stdout and json.loads(completed.stdout)[part], completed.stderr
    assert plot.read_bytes().startswith(b"\x89PNG") and list(tmp_path.iterdir()) == [plot]


def test_a_scene_that_one_recording_cannot_run_on_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "simulate", "--ticks", "1000", "--scene", "pinch"]) == 2
    assert "poses of" in capsys.readouterr().err


@pytest.mark.real_time
def test_commands_are_all_seen_and_none_torn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The force returns after each change of scene, no faster than the guard allows."""
    drawing = tmp_path / "memory.svg"
    words = ["--seconds", "1", "--rate", "100", "--swaps", "1", "--plot", str(drawing), "--json"]
    assert main(["bench", "commands", *words]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["set_params"] == 100 and content["ticks"] > 500 and content["torn"] == 0
    assert 50 < content["changes_felt"] <= 100  # of two within a tick, which a stall of the machine makes, one is felt
    # Rounding of the sum that makes a step.
    assert 0.0 < content["largest_step_n"] <= content["slew_n"] * (1.0 + 1e-9)
    assert len(content["resident_mb"]) == 1 and drawing.stat().st_size > 0


def test_a_torn_parameter_set_is_detected() -> None:
    """Stiffness and force of two pairs give another sum; ticks changed by the guard do not count."""
    rows = np.zeros((4, 6))
    rows[:, 2] = [FORCE_N, 1.0 + 1.5, FORCE_N, 0.5]
    rows[3, 3] = 2.0
    assert count_torn(rows) == 1


@pytest.mark.real_time
def test_a_page_that_cannot_be_opened_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert main(["bench", "view", "--browsers", "1"]) == ConfigError.exit_code


def test_a_source_that_ends_before_its_first_message_is_reported() -> None:
    words = [sys.executable, "-c", "raise SystemExit(3)"]
    expected = "before it ended with exit code 3: run "
    with pytest.raises(NoTelemetry, match=expected), run_source(words, "tcp://127.0.0.1:1"):
        pass


def test_misses_are_counted_among_the_ticks_that_were_due() -> None:
    """Of two turns with 2 misses each and 3 ticks each, 4 of 10 were missed; frames are the least and the median."""
    ticks = np.array([[1e-5, 1e-4, 5.0], [1e-5, 1e-4, 5.0], [1e-5, 1e-4, 7.0]])
    result = summarize_turns([TurnResult(ticks, 0.1, [20.0, 40.0]), TurnResult(ticks, 0.3, [30.0])])
    assert result["missed_of_1000"] == pytest.approx(400.0) and result["viewer_load"] == pytest.approx(0.2)
    assert result["frames_per_s"] == {"least": 20.0, "median": 30.0}


@pytest.mark.plain
def test_each_finger_has_the_device_of_its_own_hand() -> None:
    scene = load_scene("lift-a-box")
    with open_devices(load_rig("simulated-lift-a-box"), scene) as (thumb, index):
        assert thumb is not index and thumb.info.name == index.info.name == "simulated omega.6"
    with open_devices(load_rig("replay"), scene) as (thumb, index):
        assert thumb is index


HOURS = np.linspace(0.0, 2.0, 7200)


def noisy(slope: float) -> np.ndarray:
    return 100.0 + slope * HOURS + 4.0 * (np.random.default_rng(3).random(len(HOURS)) < 0.2)


def soaked(memory: np.ndarray, lost: int = 0) -> SoakResult:
    rows = np.column_stack([memory, np.full(len(memory), 20.0), np.full(len(memory), 8.0)])
    return SoakResult(3600.0 * HOURS, {"daemon": rows}, 7_200_000, 3, 2, lost)


@pytest.mark.parametrize("slope", [0.0, 0.5, 3.0, 30.0])
def test_growth_is_found_in_noise(slope: float) -> None:
    estimate, at_least = compute_growth(HOURS, noisy(slope))
    assert estimate == pytest.approx(slope, abs=0.1) and at_least <= estimate


def test_more_than_a_megabyte_an_hour_is_a_fault() -> None:
    assert evaluate(soaked(noisy(0.3)))["faults"] == []
    (fault,) = evaluate(soaked(noisy(2.0)))["faults"]
    assert fault.startswith("daemon: resident_mb grows by 2.0")
    assert evaluate(soaked(noisy(0.0), lost=2))["faults"] == ["subscribers did not get 2 ticks"]
    step, away = noisy(0.0), noisy(0.0)
    step[4000:] += 10.0
    away[3000:3050] = np.nan
    assert evaluate(soaked(step))["faults"] == evaluate(soaked(away))["faults"] == []
